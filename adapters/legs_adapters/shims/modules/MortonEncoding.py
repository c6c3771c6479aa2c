"""MortonEncoding of NeRFICG: its compiled half; its own Python stays in use."""

from __future__ import annotations

import types

import torch
from torch import Tensor

from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["module", "morton_encode"]

MORTON_BITS = 21  # of each coordinate


@torch.no_grad()
def morton_encode(positions: Tensor) -> Tensor:
    """Return the place of each position [N, 3] along the Morton curve through their bounding cube, int64 [N]."""
    least = positions.amin(0)
    cube = (positions.amax(0) - least).amax()
    most = float(2**MORTON_BITS - 1)
    steps = (((positions - least) * (1 / cube)).nan_to_num(0).clamp(0, 1) * most).to(torch.int64)
    codes = torch.zeros(len(positions), dtype=torch.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            codes |= ((steps[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return the package with its ``_C``."""
    return complete(name, __doc__, complete(f"{name}._C", None, morton_encode))
