"""The weights of the pixels of a call, as the compiled functions take them.

A weight map made from the target need not exist in memory: two numbers do, the least and the greatest response of the
view. With them the weights are made row by row where they are used, from pixels that are in the cache already.
"""

from __future__ import annotations

from typing import Any, Dict, NamedTuple

import numpy as np

from legs_loss.kernels.codes import CURVES, formulas_in
from legs_loss.kernels.compiling import inlined, part
from legs_loss.kernels.numba_response import OperatorCode, response_row

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
# No sine, since numba's is slow: C5, as curves of the user's own, is applied by torch, to a map.
_WORDS = {"x": "x", "sqrt": "np.sqrt", "unit": "_unit"}
FORMULAS: Dict[str, str] = formulas_in(_WORDS, "np.float32({})".format)


class WeightSource(NamedTuple):
    """The source of weights: the product of what is there.

    curve: of the weight that is made from the target; 0 makes none.
    beta: of that weight.
    ranges: float32 [views, 2]: the min response, and the reciprocal of max - min + eps.
    operator: of the response that it is made from.
    responses: as of `extremes`, or empty: then they are made once more.
    map: float32 [height * width] for all views, or [views * height * width], or empty.
    """

    curve: int
    beta: np.float32
    ranges: np.ndarray
    operator: OperatorCode
    responses: np.ndarray
    map: np.ndarray


@inlined
def _unit(x):  # type: ignore[no-untyped-def]
    return min(max(x, _ZERO), _ONE)


def _made() -> Any:
    """Return the function that applies the curve of a number, compiled into its callers."""
    cases = (f"if curve == {CURVES[name]}:\n        x = {formula}\n    " for name, formula in FORMULAS.items())
    made: Dict[str, Any] = {}
    exec(f"def curved(curve, x):\n    {'el'.join(cases)}return x", globals(), made)
    return inlined(made["curved"])


_curved = _made()


@part(fastmath=False)
def weights_of_row(images, source, view, row, left, right, out):  # type: ignore[no-untyped-def]
    """Write the weights of the pixels left <= j < right of a row of a view to out."""
    height, width, count = images.height, images.width, right - left
    if source.curve == 0:
        out[:count] = _ONE
    else:
        if source.responses.size > 0:
            copy_row(source.responses[(view * images.channels * height + row) * width + left :], out, count)
        else:
            response_row(images, source.operator, view, row, left, right, out)
        _weigh(out, count, source.curve, source.beta, source.ranges[view, 0], source.ranges[view, 1])
    if source.map.size > 0:
        at = (row if source.map.size == height * width else view * height + row) * width + left
        _multiply(out, source.map[at:], count)


@part(fastmath=False)
def _weigh(out, count, curve, beta, low, scale):  # type: ignore[no-untyped-def]
    for j in range(count):
        out[j] = _ONE + beta * _curved(curve, (out[j] - low) * scale)


@part(fastmath=False)
def copy_row(row, out, count):  # type: ignore[no-untyped-def]
    """Copy the first values of a row."""
    for j in range(count):
        out[j] = row[j]


@part(fastmath=False)
def _multiply(out, factor, count):  # type: ignore[no-untyped-def]
    for j in range(count):
        out[j] *= factor[j]
