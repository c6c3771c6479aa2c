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
from legs_loss.kernels.compiling import claimed, compiled, in_threads, inlined

BAND = 16  # strips
MOST_BANDS = 1 << 15  # in an image: of 8 x 32 pixel strips, 134 million pixels

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
    depths: np.ndarray, firsts: np.ndarray, reached: np.ndarray, across: int, down: int
) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where each strip's entries begin [strips + 1], the entries [E, 3] by strip and then depth, and the bands.

    Of the bands [B, 2], the fullest first, to be distributed to the workers: the first strip, and the one past
    the last.

    Raises:
        LegsError: the image, ``across`` times ``down`` strips, is too large.
    """
    ranges, draws = np.zeros(across * down + 1, np.int64), np.empty((len(reached), 3), np.int32)
    keys = np.empty(len(reached), np.uint32)
    _by_strip(depths.view(np.uint32), firsts, reached, ranges, keys, draws)
    in_threads(_by_depth, len(ranges) - 1, ranges, keys, draws)
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


@compiled(_nrt=True)
def _by_strip(depths, firsts, reached, ranges, keys, draws):
    """Fill each strip's entries in the order of their splats, and `keys` with the bits of their depths."""
    for slot in range(len(reached)):
        ranges[reached[slot, STRIP] + 1] += 1
    ranges[0] = 0  # those that reach none
    for strip in range(1, len(ranges)):
        ranges[strip] += ranges[strip - 1]
    cursors = ranges.copy()
    for i in range(np.uint64(len(depths))):
        first_sum = firsts[i, FIRST_SUM]
        for slot in range(np.uint64(firsts[i, FIRST_SLOT]), np.uint64(firsts[i + np.uint64(1), FIRST_SLOT])):
            strip = reached[slot, STRIP]
            if strip >= 0:
                at, (_, _, band) = np.uint64(strip), unpacked(reached[slot, ROWS])
                place = np.uint64(cursors[at])
                cursors[at] += 1
                keys[place], draws[place, OWNER], draws[place, ROWS] = depths[i], i, reached[slot, ROWS]
                draws[place, SUM] = first_sum + band


@inlined
def _sort_strip(keys, draws):
    """Sort the entries of a strip, front to back; equal depths keep their order: a radix sort by bytes.

    Depths are positive: their bits, as integers, sort as they do.
    """
    count, entries, starts = np.uint64(len(keys)), draws.copy(), np.zeros((4, 256), np.uint32)
    order, other = np.empty(len(keys), np.uint32), np.empty(len(keys), np.uint32)
    for i in range(count):
        order[i] = i
        for digit in range(4):
            starts[digit, keys[i] >> 8 * digit & 255] += 1
    for digit in range(4):
        if starts[digit, keys[0] >> 8 * digit & 255] == count:
            continue  # a byte that all share
        total = np.uint32(0)
        for byte in range(256):
            starts[digit, byte], total = total, total + starts[digit, byte]
        for k in range(count):
            i = order[k]
            byte = keys[i] >> 8 * digit & 255
            other[starts[digit, byte]] = i
            starts[digit, byte] += 1
        order, other = other, order
    for k in range(count):
        for column in range(3):
            draws[k, column] = entries[order[k], column]


@compiled(_nrt=True)
def _by_depth(counter, strips, ranges, keys, draws):
    strip = claimed(counter)
    while strip < strips:
        begin, end = ranges[strip], ranges[strip + 1]
        if end - begin > 1:
            _sort_strip(keys[begin:end], draws[begin:end])
        strip = claimed(counter)
