"""The functions of torch_scatter that Scaffold-GS and its family use, where it is not installed.

Pip compiles it. Other functions can be imported, and raise an error when they are used.
"""

from __future__ import annotations

import types
from typing import Optional, Tuple

import torch
from torch import Tensor

from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import MissingShim, complete

__all__ = ["module", "scatter_add", "scatter_max", "scatter_mean", "scatter_sum"]

REAL_FIRST = True


def scatter_sum(
    src: Tensor, index: Tensor, dim: int = -1, out: Optional[Tensor] = None, dim_size: Optional[int] = None
) -> Tensor:
    """Sum values of equal index along ``dim``; 0 for an index without values."""
    index, shape = _groups("scatter_sum", src, index, dim, out, dim_size)
    return src.new_zeros(shape).scatter_add(dim, index, src)


def scatter_add(
    src: Tensor, index: Tensor, dim: int = -1, out: Optional[Tensor] = None, dim_size: Optional[int] = None
) -> Tensor:
    """`scatter_sum`."""
    return scatter_sum(src, index, dim, out, dim_size)


def scatter_mean(
    src: Tensor, index: Tensor, dim: int = -1, out: Optional[Tensor] = None, dim_size: Optional[int] = None
) -> Tensor:
    """Average values of equal index along ``dim``; 0 for an index without values. Integers are rounded down."""
    index, shape = _groups("scatter_mean", src, index, dim, out, dim_size)
    counts = src.new_zeros(shape).scatter_add(dim, index, torch.ones_like(src)).clamp_min(1)
    total = src.new_zeros(shape).scatter_add(dim, index, src)
    return total / counts if src.is_floating_point() else torch.div(total, counts, rounding_mode="floor")


def scatter_max(
    src: Tensor, index: Tensor, dim: int = -1, out: Optional[Tensor] = None, dim_size: Optional[int] = None
) -> Tuple[Tensor, Tensor]:
    """Return the largest of the values of equal index along ``dim``, and its position, the first of equal ones.

    For an index without values they are 0 and the size of ``src``.
    """
    index, shape = _groups("scatter_max", src, index, dim, out, dim_size)
    size = src.shape[dim]
    with torch.no_grad():
        largest = src.new_zeros(shape).scatter_reduce_(dim, index, src, "amax", include_self=False)
        line = torch.arange(size).reshape([-1] + [1] * (src.dim() - 1)).transpose(0, dim)
        places = torch.where(src == largest.gather(dim, index), line, torch.full_like(line, size))
        where = torch.full(shape, size).scatter_reduce_(dim, index, places, "amin")
    # By position, so that only that value gets a gradient.
    edge = src.new_zeros([1 if i == dim % src.dim() else length for i, length in enumerate(src.shape)])
    return torch.cat([src, edge], dim).gather(dim, where), where


def _groups(
    name: str, src: Tensor, index: Tensor, dim: int, out: Optional[Tensor], dim_size: Optional[int]
) -> Tuple[Tensor, Tuple[int, ...]]:
    """Return the index in the shape of ``src``, and the shape of the result."""
    if out is not None:
        raise MissingShim("torch_scatter", f"{name}(out=...)")
    if index.dim() == 1:
        index = index.reshape([-1 if i == dim % src.dim() else 1 for i in range(src.dim())])
    index = index.reshape(list(index.shape) + [1] * (src.dim() - index.dim())).expand_as(src)
    shape = list(src.shape)
    shape[dim] = dim_size if dim_size is not None else int(index.max()) + 1 if index.numel() else 0
    return index, tuple(shape)


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``torch_scatter``."""
    return complete(name, __doc__, scatter_sum, scatter_add, scatter_mean, scatter_max, deferred=True)
