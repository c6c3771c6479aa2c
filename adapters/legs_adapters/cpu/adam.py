"""Adam's step in one pass over memory, for backends that bring their own."""

# mypy: ignore-errors
# (numba infers the types)

from __future__ import annotations

import math

from legs_loss.kernels.compiling import compiled

__all__ = ["update"]


@compiled(fastmath=False)
def update(parameter, gradient, moment1, moment2, new1, new2, rate, correction, epsilon):
    """Update flat arrays of one type in place.

    `new1`, `new2`: 1 - beta of the moments; `rate`: the learning rate over the first one's bias; `correction`: 1 over
    the root of the second one's.
    """
    for i in range(parameter.size):
        g = gradient[i]
        moment1[i] += new1 * (g - moment1[i])
        moment2[i] += new2 * (g * g - moment2[i])
        parameter[i] -= rate * moment1[i] / (math.sqrt(moment2[i]) * correction + epsilon)
