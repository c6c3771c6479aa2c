"""Adam in one pass over memory, eight numbers at a time: LLVM does not vectorise a loop over five arrays."""

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import claimed, compiled, inlined
from legs_loss.lab.simd.arithmetic import splat, square_root
from legs_loss.lab.simd.memory import load, store
from legs_loss.lab.simd.vectors import LANES

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


@inlined
def _one(parameter, gradient, moment1, moment2, i, rate, correction):  # type: ignore[no-untyped-def]
    """Update one number as `_eight` does."""
    g = gradient[i]
    moment1[i] += _NEW1 * (g - moment1[i])
    moment2[i] += _NEW2 * (g * g - moment2[i])
    parameter[i] -= rate * moment1[i] / (np.sqrt(moment2[i]) * correction + _EPS)


@compiled(fastmath=False)
def update(counter, parts, parameter, gradient, moment1, moment2, starts, length, rates, correction):  # type: ignore[no-untyped-def]
    """Update parts of flat float32 arrays in place: from each of ``starts`` on, so many numbers, ``rates`` theirs.

    The rates are already divided by the first moment's bias; ``correction`` is 1 / sqrt(the second one's).
    """
    part = claimed(counter)
    while part < parts:
        start = starts[part]
        end = min(start + length, parameter.size)
        whole = end - (end - start) % LANES
        for i in range(start, whole, LANES):
            _eight(parameter, gradient, moment1, moment2, i, rates, i - start, correction)
        for i in range(whole, end):
            _one(parameter, gradient, moment1, moment2, i, rates[i - start], correction)
        part = claimed(counter)
