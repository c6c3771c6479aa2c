"""Adam in one pass over memory, eight numbers at a time: LLVM does not vectorise a loop over five arrays."""

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import compiled, inlined
from legs_loss.kernels.simd.arithmetic import splat, square_root
from legs_loss.kernels.simd.memory import load, store
from legs_loss.kernels.simd.vectors import LANES

__all__ = ["BETA1", "BETA2", "LANES", "update"]

BETA1, BETA2 = 0.9, 0.999
_NEW1, _NEW2, _EPS = np.float32(1 - BETA1), np.float32(1 - BETA2), np.float32(1e-15)


@inlined
def _eight(parameter, gradient, moment1, moment2, i, rates, j, correction):  # type: ignore[no-untyped-def]
    """Update eight numbers from `i` on, with the rates from `j` on."""
    g, m1, m2 = load(gradient, i), load(moment1, i), load(moment2, i)
    m1 = m1 + splat(_NEW1) * (g - m1)
    m2 = m2 + splat(_NEW2) * (g * g - m2)
    store(moment1, i, m1)
    store(moment2, i, m2)
    change = load(rates, j) * m1 / (square_root(m2) * splat(correction) + splat(_EPS))
    store(parameter, i, load(parameter, i) - change)


@compiled(fastmath=False)
def update(parameter, gradient, moment1, moment2, rates, correction):  # type: ignore[no-untyped-def]
    """Update flat float32 arrays in place; ``rates`` is one block of learning rates, which repeats, of whole vectors.

    The rates are already divided by the first moment's bias; ``correction`` is 1 / sqrt(the second one's).
    """
    whole = parameter.size - parameter.size % LANES
    for start in range(0, whole, rates.size):
        for j in range(0, min(rates.size, whole - start), LANES):
            _eight(parameter, gradient, moment1, moment2, start + j, rates, j, correction)
    if whole < parameter.size:  # what is left, as part of a vector
        last = np.zeros((4, LANES), np.float32)
        for k in range(parameter.size - whole):
            last[0, k], last[1, k] = parameter[whole + k], gradient[whole + k]
            last[2, k], last[3, k] = moment1[whole + k], moment2[whole + k]
        _eight(last[0], last[1], last[2], last[3], 0, rates, whole % rates.size, correction)
        for k in range(parameter.size - whole):
            parameter[whole + k], moment1[whole + k], moment2[whole + k] = last[0, k], last[2, k], last[3, k]
