"""Textures of the embedded scene, drawn by code: brick, checker, planks, stripes, noise, charts and text.

Every texture is a float32 array [height, width, 3] with values in [0, 1]; its first row is the top.
"""

from __future__ import annotations

from typing import List, Sequence, Tuple

import numpy as np

Colour = Tuple[float, float, float]

# A 5 x 7 bitmap font: five columns a glyph, bit 0 of a column is its top row.
_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 .-+=()"
_COLUMNS = bytes.fromhex(
    "7e1111117e7f494949363e414141227f4141221c7f494949417f090909013e4149497a7f0808087f00417f41002040413f01"
    "7f081422417f404040407f020c027f7f0408107f3e4141413e7f090909063e4151215e7f09192946464949493101017f0101"
    "3f4040403f1f2040201f3f4038403f6314081463070870080761514945433e5149453e00427f400042615149462141454b31"
    "1814127f1027454545393c4a49493001710905033649494936064949291e00000000000060600000080808080808083e0808"
    "1414141414001c2241000041221c00"
)


def text_mask(text: str) -> np.ndarray:
    """Return the pixels of one line of capitals, digits and ``.-+=()``: bool [7, 6 * len(text) - 1].

    >>> print("\\n".join("".join(".#"[int(p)] for p in row) for row in text_mask("LE")))
    #.....#####
    #.....#....
    #.....#....
    #.....####.
    #.....#....
    #.....#....
    #####.#####
    """
    columns: List[int] = []
    for letter in text.upper():
        first = 5 * _LETTERS.index(letter)
        columns += [*_COLUMNS[first : first + 5], 0]
    bits = np.array(columns[:-1])[None, :] >> np.arange(7)[:, None]
    return (bits & 1).astype(bool)


def plain(size: Tuple[int, int], colour: Colour) -> np.ndarray:
    """Return one colour; ``size`` is (height, width)."""
    return np.broadcast_to(np.asarray(colour, np.float32), tuple(size) + (3,)).copy()


def smooth_noise(size: Tuple[int, int], cells: int, random: np.random.RandomState) -> np.ndarray:
    """Return value noise in [0, 1], [height, width]: about ``cells`` bumps along the shorter side."""
    height, width = size
    step = min(height, width) / float(cells)
    rows, columns = np.arange(height) / step, np.arange(width) / step
    lattice = random.rand(int(rows[-1]) + 2, int(columns[-1]) + 2)
    r, c = rows.astype(int), columns.astype(int)
    fr, fc = (rows - r)[:, None], (columns - c)[None, :]
    fr, fc = fr * fr * (3 - 2 * fr), fc * fc * (3 - 2 * fc)
    top = lattice[r][:, c] * (1 - fc) + lattice[r][:, c + 1] * fc
    bottom = lattice[r + 1][:, c] * (1 - fc) + lattice[r + 1][:, c + 1] * fc
    return (top * (1 - fr) + bottom * fr).astype(np.float32)


def fractal_noise(size: Tuple[int, int], cells: int, octaves: int, random: np.random.RandomState) -> np.ndarray:
    """Sum octaves of ``smooth_noise``, each twice as fine and 0.6 as strong, in [0, 1]."""
    total = np.zeros(size, np.float32)
    for octave in range(octaves):
        total += 0.6**octave * smooth_noise(size, cells * 2**octave, random)
    return (total - total.min()) / (total.max() - total.min())


def tint(noise: np.ndarray, dark: Colour, light: Colour) -> np.ndarray:
    """Return a ramp from ``dark`` to ``light`` along values in [0, 1]."""
    low, high = np.asarray(dark, np.float32), np.asarray(light, np.float32)
    return low + noise[..., None] * (high - low)


def checker(size: Tuple[int, int], cell: int, dark: Colour, light: Colour, random: np.random.RandomState) -> np.ndarray:
    """Return a checkerboard with ``cell``-texel fields, each field a slightly different shade."""
    rows, columns = np.arange(size[0]) // cell, np.arange(size[1]) // cell
    odd = (rows[:, None] + columns[None, :]) % 2
    shade = 1 - 0.16 * random.rand(rows[-1] + 1, columns[-1] + 1)[rows][:, columns]
    speckle = 1 - 0.10 * random.rand(*size)
    return tint(odd.astype(np.float32), dark, light) * (shade * speckle)[..., None].astype("f4")


def brick(size: Tuple[int, int], length: int, course: int, random: np.random.RandomState) -> np.ndarray:
    """Return a running bond of bricks, ``length`` x ``course`` texels each, with light mortar."""
    rows, columns = np.arange(size[0])[:, None], np.arange(size[1])[None, :]
    layer = rows // course
    shifted = columns + (layer % 2) * (length // 2)
    joint = max(1, course // 9)
    mortar = (rows % course < joint) | (shifted % length < joint)
    tones = random.rand(size[0] // course + 1, (size[1] + length) // length + 1)
    tone = 0.65 * tones[layer, shifted // length] + 0.35 * fractal_noise(size, 20, 3, random)
    bricks = tint(tone.astype(np.float32), (0.47, 0.20, 0.14), (0.74, 0.40, 0.29))
    bricks[mortar] = (0.80, 0.77, 0.72)
    return bricks * (1 - 0.08 * random.rand(*size))[..., None].astype(np.float32)


def planks(size: Tuple[int, int], plank: int, random: np.random.RandomState) -> np.ndarray:
    """Return wooden planks ``plank`` texels wide, with a grain along the rows."""
    height, width = size
    grain = fractal_noise((height, max(width // 12, 8)), 24, 4, random)
    grain = np.repeat(grain, 13, axis=1)[:, :width]
    index = np.arange(height) // plank
    tone = 0.75 * grain + 0.25 * random.rand(index[-1] + 1)[index][:, None]
    wood = tint(tone, (0.36, 0.22, 0.12), (0.80, 0.58, 0.36))
    wood[np.arange(height) % plank == 0] *= 0.45
    return wood.astype(np.float32)


def stripes(size: Tuple[int, int], widths: Sequence[int], colours: Sequence[Colour]) -> np.ndarray:
    """Return vertical stripes whose widths and colours repeat in turn."""
    edges = np.cumsum(widths)
    index = np.searchsorted(edges, np.arange(size[1]) % edges[-1], side="right")
    pattern = np.arange(size[1]) // edges[-1] * len(widths) + index
    row = np.asarray(colours, np.float32)[pattern % len(colours)]
    return np.broadcast_to(row, tuple(size) + (3,)).copy()


def star(size: int, spokes: int) -> np.ndarray:
    """Return a Siemens star on white, black and white spokes that meet in the middle, inside rings."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2.0
    radius, angle = np.hypot(x, y) / (size / 2.0), np.arctan2(y, x)
    black = (np.sin(angle * spokes) > 0) & (radius < 0.78)
    black |= (radius > 0.84) & (radius < 0.88) | (radius > 0.93) & (radius < 0.95)
    chart = plain((size, size), (0.95, 0.95, 0.93))
    chart[black] = (0.06, 0.06, 0.08)
    return chart


def write(texture: np.ndarray, text: str, row: int, column: int, scale: int, colour: Colour) -> np.ndarray:
    """Write a line of text into ``texture`` (in place) with ``scale`` texels a font pixel."""
    mask = np.kron(text_mask(text), np.ones((scale, scale))).astype(bool)
    patch = texture[row : row + mask.shape[0], column : column + mask.shape[1]]
    patch[mask[: patch.shape[0], : patch.shape[1]]] = colour
    return texture


def framed(texture: np.ndarray, border: int, colour: Colour) -> np.ndarray:
    """Paint a frame ``border`` texels wide onto the rim of ``texture`` (in place)."""
    for edge in (texture[:border], texture[-border:], texture[:, :border], texture[:, -border:]):
        edge[:] = colour
    return texture
