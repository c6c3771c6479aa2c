"""Prepare launches: a kernel's arguments as legs.cu reads them (``struct Task``), and the number of blocks."""

from __future__ import annotations

import ctypes
from typing import Dict, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.kernels.cuda.modules import Variant
from legs_loss.spec import WeightSpec

__all__ = [
    "CURVES",
    "NORMS",
    "STENCILS",
    "THREADS",
    "VALUES",
    "Layout",
    "Task",
    "addressable",
    "chunks_of",
    "strip_of",
    "variant_of",
]

THREADS = 128
VALUES = {torch.float32: 0, torch.float16: 1, torch.bfloat16: 2}
# kind of stencil, the weights of a gradient's outer and middle rows
STENCILS: Dict[str, Tuple[int, float, float]] = {
    "laplacian": (1, 0.0, 0.0),
    "laplacian8": (2, 0.0, 0.0),
    "central": (3, 0.0, 0.5),
    "sobel": (3, 1.0, 2.0),
    "scharr": (3, 3.0, 10.0),
}
NORMS = {1.0: 1, 2.0: 2, float("inf"): 3}
CURVES = {"C1": 1, "C2": 2, "C3": 3, "C4": 4, "C5": 5}

_REACH = 5  # of SSIM's window
_BLOCKS_AT_A_TIME = 4  # of a multiprocessor: 128 registers a thread
_MOST = 2**31 - 1


class Layout(ctypes.Structure):
    """The strides of images [B, C, H, W], in values."""

    _fields_ = [
        ("view", ctypes.c_longlong),
        ("channel", ctypes.c_longlong),
        ("row", ctypes.c_int),
        ("column", ctypes.c_int),
    ]


class Task(ctypes.Structure):
    """``struct Task`` of legs.cu, where each field is described."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("prediction", "target", "gradient", "scaled", "step", "partial")),
        *((name, ctypes.c_void_p) for name in ("result", "map", "mask", "covered", "range")),
        *((name, Layout) for name in ("of_prediction", "of_target", "of_gradient")),
        *((name, ctypes.c_longlong) for name in ("map_view", "mask_view", "count")),
        *((name, ctypes.c_int) for name in ("views", "channels", "height", "width", "strip", "curve", "chunks")),
        *((name, ctypes.c_float) for name in ("side", "middle", "beta", "eps")),
        *((name, ctypes.c_float) for name in ("l1_share", "ssim_share", "constant")),
    ]

    views: int
    channels: int
    height: int
    width: int
    curve: int
    side: float
    middle: float
    beta: float
    eps: float

    def show(self, name: str, images: Tensor) -> None:
        """Set an image's pointer and its layout."""
        view, channel, row, column = images.stride()
        setattr(self, name, images.data_ptr())
        setattr(self, f"of_{name}", Layout(view, channel, row, column))

    def measure(self, images: Tensor) -> None:
        """Set the size."""
        self.views, self.channels, self.height, self.width = images.shape

    def weigh(self, spec: WeightSpec) -> None:
        """Set the parameters of a spec's weights except the range."""
        _, self.side, self.middle = STENCILS[spec.operator]
        self.curve, self.beta, self.eps = CURVES.get(spec.curve, 0), spec.beta, spec.eps


def variant_of(dtype: torch.dtype, spec: Optional[WeightSpec]) -> Variant:
    """Return which variant of the kernels computes images of a type with the weights of a spec, or of a map or none."""
    if spec is None:
        return Variant(VALUES[dtype])
    return Variant(VALUES[dtype], STENCILS[spec.operator][0], NORMS[spec.p])


def addressable(images: Tensor) -> Tensor:
    """Return images [B, C, H, W] whose planes the kernels can address: copies only for huge strides."""
    _, _, row, column = images.stride()
    reach = (images.shape[2] - 1) * row + (images.shape[3] - 1) * column
    return images if max(row, column, reach) <= _MOST else images.contiguous()


def strip_of(images: Tensor, multiprocessors: int, wanted: bool) -> Tuple[int, int]:
    """Return how many rows a block of the streaming pass does, and how many blocks there are.

    Every strip repeats the rows above and below it, so strips are long; but all multiprocessors should have work.
    """
    views, channels, height, width = images.shape
    halo = 2 * _REACH if wanted else _REACH
    tiles = -(-width // (THREADS - 2 * halo)) * views * channels
    at_a_time = _BLOCKS_AT_A_TIME * multiprocessors

    def cost(strip: int) -> int:
        return -(-tiles * -(-height // strip) // at_a_time) * (min(strip, height) + 2 * halo)

    strip = min(range(16, 513, 16), key=cost)
    return strip, tiles * -(-height // strip)


def chunks_of(images: Tensor, multiprocessors: int) -> int:
    """Return how many blocks a view gets in a pass that goes pixel by pixel."""
    views, _, height, width = images.shape
    return max(1, min(-(-height * width // (4 * THREADS)), -(-16 * multiprocessors // views)))
