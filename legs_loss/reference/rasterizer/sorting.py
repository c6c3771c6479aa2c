"""Find the strips that each splat reaches, and sort a strip's splats by depth: slots, entries and bands.

A slot is a strip in a splat's box of strips. Those that the splat reaches are sorted by strip and depth: the entries.
A band is a row of strips that one thread draws, in their order: a splat that reaches several of them is still in the
cache, and the gradients of its entries there are added up in a row of sums of their own, always in the same order.
"""

# mypy: ignore-errors
# (numba infers the types, by its own rules)

from __future__ import annotations

from typing import Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.kernels.compiling import compiled, inlined
from legs_loss.kernels.simd.memory import prefetch

BAND = 16  # strips
MOST_BANDS = 1 << 15  # in an image: of 8 x 32 pixel strips, 134 million pixels
AHEAD = 16  # splats whose slots are asked for while another's are worked on

FIRST_SLOT, FIRST_SUM = 0, 1  # where a splat's slots begin, and its rows of sums
STRIP, ROWS = 0, 1  # of a slot: its strip, or -1 where the splat does not reach it, and its rows (see `packed`)
OWNER, SUM = 0, 2  # of an entry: its splat, and, after its ROWS, the row of sums that its gradient is added to


def make_slots(boxes: np.ndarray, slots: np.ndarray, tall: int) -> Tuple[np.ndarray, np.ndarray]:
    """Return where each splat's slots and rows of sums begin [N + 1, 2], and the slots [S, 2], not yet filled.

    There is a row of sums for each band that a splat's box touches.

    Args:
        boxes: [N, 4], in strips across and pixels down: left, top, and what is past right and bottom.
        slots: [N], how many strips are in each box; 0 where a splat is not drawn.
        tall: of a strip, in pixels.
    """
    firsts = np.empty((len(slots) + 1, 2), np.int64)
    _number(boxes, slots, tall, firsts)
    return firsts, np.empty((int(firsts[-1, FIRST_SLOT]), 2), np.int32)


def sort_entries(
    depths: np.ndarray, slots: np.ndarray, firsts: np.ndarray, reached: np.ndarray, across: int, down: int
) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where each strip's entries begin [strips + 1], the entries [E, 3] by strip and then depth, and the bands.

    Of the bands [B, 2], the fullest first, to be distributed to the workers: the first strip, and the one past
    the last.

    Raises:
        LegsError: the image, ``across`` times ``down`` strips, is too large.
    """
    ranges, draws = np.zeros(across * down + 1, np.int64), np.empty((len(reached), 3), np.int32)
    _sort_slots(order_by_depth(depths, slots), firsts, reached, ranges, draws)
    rows = np.arange(0, across * down, across)[:, None]
    begins = (rows + np.arange(0, across, BAND)).reshape(-1)
    ends = np.minimum(rows + np.arange(BAND, across + BAND, BAND), rows + across).reshape(-1)
    if len(begins) > MOST_BANDS:
        raise LegsError(f"an image of {across} x {down} strips cannot be drawn: it has more than {MOST_BANDS} bands")
    return ranges, draws, np.stack([begins, ends], 1)[np.argsort(ranges[begins] - ranges[ends], kind="stable")]


def make_sums(firsts: np.ndarray, fields: int) -> np.ndarray:
    """Return the rows of sums, all 0: np.zeros would have their memory mapped anew at every call."""
    sums = np.empty((int(firsts[-1, FIRST_SUM]), fields), np.float32)
    sums[:] = 0
    return sums


@compiled()
def _number(boxes, slots, tall, firsts):
    slot, row, tall = 0, 0, np.uint32(tall)  # 32 bits are divided in half the time
    for i in range(len(slots)):
        firsts[i, FIRST_SLOT], firsts[i, FIRST_SUM] = slot, row
        if slots[i] > 0:
            slot += slots[i]
            down = np.uint32(boxes[i, 3] - 1) // tall + 1 - np.uint32(boxes[i, 1]) // tall
            row += bands_across(boxes[i, 0], boxes[i, 2]) * np.int64(down)
    firsts[len(slots), FIRST_SLOT], firsts[len(slots), FIRST_SUM] = slot, row


@inlined
def band_at(strip_x):
    """Return how many bands are left of a strip's."""
    return np.int32(np.uint32(strip_x) // np.uint32(BAND))


@inlined
def bands_across(first, end):
    """Return how many bands the strips from ``first`` to ``end`` in a row touch."""
    return band_at(end - 1) + 1 - band_at(first)


@inlined
def packed(first, end, band):
    """Return a slot's ROWS: the first row that the splat reaches, the one past its last, and the box's band."""
    return np.int32(first) | np.int32(end) << 8 | np.int32(band) << 16


@inlined
def unpacked(rows):
    """Return the three numbers of a `packed` one."""
    return rows & 255, rows >> 8 & 255, rows >> 16


@compiled()
def order_by_depth(depths, slots):
    """Return indices of the splats that are drawn, front to back; equal depths keep their order. A radix sort."""
    bits, count = depths.view(np.uint32), 0
    order, starts = np.empty(len(slots), np.int32), np.zeros((3, 2049), np.int64)
    for i in range(len(slots)):
        if slots[i] > 0:
            order[count] = i
            count += 1
            for digit in range(3):  # depths are positive: their bits, as integers, sort as they do
                starts[digit, (bits[i] >> 11 * digit & 2047) + 1] += 1
    order = order[:count]
    other = np.empty_like(order)
    for digit in range(3):
        for k in range(1, 2049):
            starts[digit, k] += starts[digit, k - 1]
        for i in order:
            k = np.uint64(bits[i] >> 11 * digit & 2047)
            other[starts[digit, k]] = i
            starts[digit, k] += 1
        order, other = other, order
    return order


@compiled()
def _sort_slots(order, firsts, reached, ranges, draws):
    for slot in range(len(reached)):
        ranges[reached[slot, STRIP] + 1] += 1
    ranges[0] = 0  # those that reach none
    for strip in range(1, len(ranges)):
        ranges[strip] += ranges[strip - 1]
    cursors = ranges.copy()
    for turn in range(len(order)):
        prefetch(firsts, order[min(turn + 2 * AHEAD, len(order) - 1)])
        prefetch(reached, firsts[order[min(turn + AHEAD, len(order) - 1)], FIRST_SLOT])
        owner = order[turn]
        i = np.uint64(owner)
        first_sum = firsts[i, FIRST_SUM]
        for slot in range(np.uint64(firsts[i, FIRST_SLOT]), np.uint64(firsts[i + np.uint64(1), FIRST_SLOT])):
            strip = reached[slot, STRIP]
            if strip >= 0:
                at, (_, _, band) = np.uint64(strip), unpacked(reached[slot, ROWS])
                place = np.uint64(cursors[at])
                cursors[at] += 1
                draws[place, OWNER], draws[place, ROWS] = owner, reached[slot, ROWS]
                draws[place, SUM] = first_sum + band
