"""Clip splats to the tiles of FastGS's compact box, an ellipse smaller than the one where alpha is 1/255.

Where opacity * exp(-q / 2) = 1/255, q is 2 ln(255 opacity); the compact box takes the ellipse at ``mult`` times that.
A tile of 16x16 pixels is drawn whole if the ellipse enters it, by the tile's lines, and not at all if not: along the
box's shorter side the tiles are taken slice by slice, and in each slice from the ellipse's least to its largest
coordinate. Source: FastGS (Ren et al. 2025), after Speedy-Splat (Hanson et al. 2025).
"""

# mypy: ignore-errors
# (numba infers the types)

from __future__ import annotations

import math
from typing import Tuple

import numpy as np
from torch import Tensor

from legs_loss.kernels.compiling import claimed, compiled, in_threads, part
from legs_loss.lab.conventions import TILE
from legs_loss.lab.rasterizer.geometry import conic
from legs_loss.lab.rasterizer.projection import BLOCK, TALL, WIDE
from legs_loss.lab.rasterizer.sorting import FIRST_SLOT, ROWS, STRIP, packed, unpacked


class CompactBox:
    """Clip splats to their compact boxes: the ``clip`` of `compiled.draw`.

    Args:
        opacities: [N, 1].
        mult: the share of the squared distance at alpha 1/255.
    """

    def __init__(self, opacities: Tensor, mult: float) -> None:
        self.opacities: np.ndarray = opacities.detach().contiguous().numpy()
        self.mult: float = float(mult)

    def __call__(
        self,
        tiles: Tuple[int, int],
        splats: np.ndarray,
        boxes: np.ndarray,
        slots: np.ndarray,
        firsts: np.ndarray,
        reached: np.ndarray,
        radii: np.ndarray,
    ) -> None:
        """Take the rows outside the boxes from the slots, and the radii of Gaussians that enter no tile."""
        blocks = -(-len(slots) // BLOCK)
        in_threads(_clip, blocks, splats, self.opacities, self.mult, tiles, boxes, slots, firsts, reached, radii)
        # For FastGS a Gaussian that reaches no pixel's centre is visible if it enters a tile.
        faint = np.nonzero((slots == 0) & (radii > 0))[0]
        opacities = self.opacities[faint, 0].astype(np.float64)
        radii[faint[~_touches(splats[faint, :5], opacities, self.mult, tiles)]] = 0


@part()
def _crossings(a, b, c, disc, t, u0, v0, at):
    """Return the two v at which the ellipse crosses the line u = at; c is the coefficient of v."""
    h = at - u0
    root = math.sqrt(max(disc * h * h + t * c, 0.0))
    return (-b * h - root) / c + v0, (-b * h + root) / c + v0


@part()
def _tile(value, tiles):
    """Return the tile of a coordinate, truncated as C does, within the image."""
    return min(max(np.int64(value), 0), tiles)


@part()
def _slices(a, b, c, t, u0, v0, least, most, u_tiles, v_tiles, spans):
    """Fill, for each tile along u, the first tile along v and the one past the last; the ellipse is given in (u, v).

    ``least`` and ``most``: (u, v) of the box, then at which u the extreme v lie.
    """
    disc = b * b - a * c
    first, end = _tile(least[0] / TILE, u_tiles), _tile(most[0] / TILE + 1, u_tiles)
    v_first, v_end = _tile(least[1] / TILE, v_tiles), _tile(most[1] / TILE + 1, v_tiles)
    low, high = most[1], least[1]  # of the line before: neither least nor largest of anything
    if least[0] <= first * TILE:
        low, high = _crossings(a, b, c, disc, t, u0, v0, first * TILE)
    next_low, next_high = most[1], least[1]
    count = 0
    for tile in range(first, end):
        line, next_line = tile * TILE, (tile + 1) * TILE
        if next_line <= most[0]:
            next_low, next_high = _crossings(a, b, c, disc, t, u0, v0, next_line)
        smallest, largest = min(low, next_low), max(high, next_high)
        if line <= least[2] and least[2] < next_line:
            smallest = least[1]
        if line <= most[2] and most[2] < next_line:
            largest = most[1]
        spans[tile, 0] = max(v_first, min(v_end, np.int64(smallest / TILE)))
        spans[tile, 1] = min(v_end, max(v_first, np.int64(largest / TILE + 1)))
        count += max(spans[tile, 1] - spans[tile, 0], 0)
        low, high = next_low, next_high
    return first, end, count


@part()
def _reach(splats, i, opacity, mult, tiles, spans):
    """Return which tiles a splat is drawn in: whether ``spans`` go by rows, their first and end, how many tiles."""
    x, y = splats[i, 0], splats[i, 1]
    a, b, c = conic(splats[i, 2], splats[i, 3], splats[i, 4])
    t = mult * 2 * math.log(opacity * 255)
    disc = b * b - a * c
    if not (t > 0 and disc < 0):
        return False, 0, 0, 0
    reach_x, reach_y = math.sqrt(t * c / -disc), math.sqrt(t * a / -disc)
    # Where the ellipse is highest and lowest, x is off the centre by this, and likewise y at its sides.
    at_x, at_y = -b / a * reach_y, -b / c * reach_x
    across = _tile((x + reach_x) / TILE + 1, tiles[0]) - _tile((x - reach_x) / TILE, tiles[0])
    down = _tile((y + reach_y) / TILE + 1, tiles[1]) - _tile((y - reach_y) / TILE, tiles[1])
    first = end = count = 0
    if across * down > 0 and down < across:
        least, most = (y - reach_y, x - reach_x, y - at_y), (y + reach_y, x + reach_x, y + at_y)
        first, end, count = _slices(c, b, a, t, y, x, least, most, tiles[1], tiles[0], spans)
    elif across * down > 0:
        least, most = (x - reach_x, y - reach_y, x - at_x), (x + reach_x, y + reach_y, x + at_x)
        first, end, count = _slices(a, b, c, t, x, y, least, most, tiles[0], tiles[1], spans)
    return down < across, first, end, count


@compiled(_nrt=True)
def _touches(splats, opacities, mult, tiles):
    """Return which splats [N, 5], rows of centre and own coordinates, enter a tile, even between its pixels."""
    spans = np.empty((max(tiles[0], tiles[1]), 2), np.int64)
    found = np.zeros(len(splats), np.bool_)
    for i in range(len(splats)):
        found[i] = _reach(splats, i, opacities[i], mult, tiles, spans)[3] > 0
    return found


@compiled(_nrt=True)
def _clip(counter, blocks, splats, opacities, mult, tiles, boxes, slots, firsts, reached, radii):
    """Take from every slot the rows outside the compact box; a Gaussian with slots and no tile gets radius 0.

    Args:
        counter, blocks: of `in_threads`; a block is BLOCK Gaussians.
        splats, boxes, slots, firsts, reached, radii: as the rasterizer has them after `find_rows`.
        opacities: [N, 1].
        mult: the share of the squared distance.
        tiles: how many tiles are across, and down.
    """
    spans, block = np.empty((max(tiles[0], tiles[1]), 2), np.int64), claimed(counter)
    while block < blocks:
        for i in range(block * BLOCK, min((block + 1) * BLOCK, len(slots))):
            if slots[i] == 0:
                continue
            by_rows, first, end, count = _reach(splats, i, np.float64(opacities[i, 0]), mult, tiles, spans)
            if count == 0:
                radii[i] = 0
            slot = firsts[i, FIRST_SLOT]
            for strip_y in range(boxes[i, 1] // TALL, (boxes[i, 3] - 1) // TALL + 1):
                for strip_x in range(boxes[i, 0], boxes[i, 2]):
                    if reached[slot, STRIP] >= 0:
                        # A strip is half a tile wide and two tiles tall.
                        tile_x, upper = strip_x * WIDE // TILE, strip_y * TALL // TILE
                        row, last, band = unpacked(reached[slot, ROWS])
                        kept, kept_end = last, row
                        for tile_y in range(upper, min(upper + TALL // TILE, tiles[1])):
                            if by_rows:
                                inside = first <= tile_y < end and spans[tile_y, 0] <= tile_x < spans[tile_y, 1]
                            else:
                                inside = first <= tile_x < end and spans[tile_x, 0] <= tile_y < spans[tile_x, 1]
                            if inside:
                                kept = min(kept, (tile_y - upper) * TILE)
                                kept_end = max(kept_end, (tile_y - upper + 1) * TILE)
                        row, last = max(row, kept), min(last, kept_end)
                        if row < last:
                            reached[slot, ROWS] = packed(row, last, band)
                        else:
                            reached[slot, STRIP] = -1
                    slot += 1
        block = claimed(counter)
