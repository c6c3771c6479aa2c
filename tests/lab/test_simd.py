"""Eight numbers at once: assumptions of the compiled code that no kernel's result would show."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("numba")

A = (1.0, 2.0, 3.0, math.nan, 5.0, math.nan, -0.0, math.inf)
B = (2.0, 2.0, 1.0, 4.0, math.nan, math.nan, 0.0, math.inf)


def by_lanes(operation, *rows):
    """Apply an operation to rows of eight float32."""
    import numba

    from legs_loss.lab.simd.memory import load, store

    @numba.njit
    def two(a, b, result):
        store(result, 0, operation(load(a, 0), load(b, 0)))

    result = np.empty(8, np.float32)
    two(*(np.array(row, np.float32) for row in rows), result)
    return result.tolist()


@pytest.mark.parametrize(
    ("name", "expected"),
    [("at_least", (0, 1, 1, 0, 0, 0, 1, 1)), ("above", (0, 0, 1, 0, 0, 0, 0, 0)), ("equal", (0, 1, 0, 0, 0, 0, 1, 1))],
)
def test_comparisons_are_false_of_a_nan(name, expected):
    import numba

    from legs_loss.lab.simd import arithmetic

    compare, where, splat = getattr(arithmetic, name), arithmetic.where, arithmetic.splat

    @numba.njit
    def as_numbers(a, b):
        return where(compare(a, b), splat(np.float32(1)), splat(np.float32(0)))

    assert by_lanes(as_numbers, A, B) == list(expected)


@pytest.mark.parametrize("name", ["minimum", "maximum"])
def test_of_a_nan_the_second_is_taken(name):
    import numba

    from legs_loss.lab.simd import arithmetic

    choose = getattr(arithmetic, name)

    @numba.njit
    def of_two(a, b):
        return choose(a, b)

    taken = by_lanes(of_two, A, B)
    assert taken[3] == 4 and math.isnan(taken[4]) and math.isnan(taken[5])
    assert taken[0] == {"minimum": 1, "maximum": 2}[name]


def test_the_negative_turns_every_sign():
    import numba

    @numba.njit
    def of_first(a, b):
        return -a

    turned = by_lanes(of_first, A, B)
    assert turned[:3] == [-1, -2, -3] and turned[7] == -math.inf
    assert math.copysign(1, turned[6]) == 1  # 0 - a would leave 0.0 of 0.0, and of -0.0
    assert math.copysign(1, by_lanes(of_first, B, A)[6]) == -1


def test_eight_rows_transposed_are_their_columns():
    import numba

    from legs_loss.lab.simd.lanes import transposed
    from legs_loss.lab.simd.memory import load, store

    @numba.njit
    def turn(rows, result):
        columns = transposed(
            load(rows, 0), load(rows, 8), load(rows, 16), load(rows, 24),
            load(rows, 32), load(rows, 40), load(rows, 48), load(rows, 56),
        )  # fmt: skip
        for k in range(8):
            store(result, 8 * k, columns[k])

    rows, result = np.arange(64, dtype=np.float32), np.empty(64, np.float32)
    turn(rows, result)
    assert (result.reshape(8, 8) == rows.reshape(8, 8).T).all()
