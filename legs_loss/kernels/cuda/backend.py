"""The backend for CUDA: what each kernel is given (``struct Task`` of legs.cu), and the operations that launch them.

Nothing waits for the device. Backward multiplies by the incoming gradient, which the kernel reads on the device (and
changes nothing where it is 1). What depends on shapes, strides, types and settings alone is prepared once.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, Callable, FrozenSet, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.kernels.codes import CURVES, NORMS, STENCILS
from legs_loss.kernels.contract import Backend, PreparedLoss, Terms
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.modules import FORMULAS, PLAIN, BinaryCache, Modules, Variant, cache_folder
from legs_loss.kernels.cuda.nvrtc import find_compiler
from legs_loss.spec import WeightSpec

THREADS = 256
RUN = 8  # rows of a thread of the pixelwise passes
VALUES = {torch.float32: 0, torch.float16: 1, torch.bfloat16: 2}

_REACH = 5  # of SSIM's window
_BLOCKS_AT_A_TIME = 2  # of a multiprocessor: 128 registers a thread
_MOST = 2**31 - 1


class Strides(ctypes.Structure):
    """The strides of images [B, C, H, W], in values."""

    _fields_ = [
        *((name, ctypes.c_longlong) for name in ("view", "channel")),
        *((name, ctypes.c_int) for name in ("row", "column")),
    ]


class Task(ctypes.Structure):
    """``struct Task`` of legs.cu, where each field is described."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("prediction", "target", "gradient", "scaled", "step", "partial")),
        *((name, ctypes.c_void_p) for name in ("result", "map", "range", "response")),
        *((name, Strides) for name in ("of_prediction", "of_target", "of_gradient")),
        ("count", ctypes.c_longlong),
        *((name, ctypes.c_int) for name in ("views", "channels", "height", "width", "strip", "curve", "chunks")),
        ("map_view", ctypes.c_int),
        *((name, ctypes.c_float) for name in ("side", "middle", "beta", "eps", "l1_step", "ssim_step", "constant")),
    ]


class CudaBackend(Backend):
    """The operations on every CUDA device; its kernels are loaded when a device is first met.

    Args:
        open_device: makes the kernels of a device.
    """

    name = "cuda"
    most_channels = 1 << 16
    curves: FrozenSet[str] = frozenset(FORMULAS)

    def __init__(self, open_device: Callable[[torch.device], Modules]) -> None:
        self._open = lru_cache(maxsize=None)(open_device)  # the trial of a device, under a lock, is the first to ask

    def prepare(
        self, terms: Terms, spec: Optional[WeightSpec], prediction: Tensor, target: Tensor, wanted: bool
    ) -> PreparedLoss:
        """Return the launches of a loss of such images."""
        return _Launches(self._open(target.device), terms, spec, prediction, target, wanted)


_Launch = Tuple[Any, int, int]  # a kernel, its blocks and threads


class _Launches(PreparedLoss):
    """The launches of an operation: all but the addresses, which are written into a copy of its task."""

    def __init__(
        self, modules: Modules, terms: Terms, spec: Optional[WeightSpec], x: Tensor, y: Tensor, wanted: bool
    ) -> None:
        shape = x.shape
        self._mixed = x.dtype != y.dtype
        x, y = (_batch(one.detach().float() if self._mixed else one.detach()) for one in (x, y))
        self._launch, self._dtype, self._shape, self._ssim = modules.driver.launch, x.dtype, shape, terms.ssim
        spec = spec if terms.l1 else None
        plain = Variant(VALUES[x.dtype])
        weighted = plain if spec is None else plain._replace(stencil=STENCILS[spec.operator][0], norm=NORMS[spec.p])
        modules.load(weighted, plain, PLAIN)  # backward's too, which a capture may contain alone

        def launch(name: str, variant: Variant, blocks: int) -> _Launch:
            return modules.function(f"legs_{name}", variant), blocks, THREADS

        # Strides that the kernels cannot address are made contiguous first.
        self._copies = not _is_addressable(x), not _is_addressable(y)
        views, channels, height, width = x.shape
        self._task = task = Task(views=views, channels=channels, height=height, width=width)
        self._views, self._pixels = views, (height * width, views * height * width)  # a map's: for all views, for each
        x, y = x.contiguous() if self._copies[0] else x, y.contiguous() if self._copies[1] else y
        task.of_prediction, self._strides_of_prediction = Strides(*x.stride()), x.stride()[-len(self._shape) :]
        task.of_target, self._strides_of_target = Strides(*y.stride()), y.stride()[-len(self._shape) :]
        task.chunks = chunks_of(x)
        self._ranged = task.count = task.chunks * task.views
        self._ranging: Tuple[_Launch, ...] = ()
        if spec is not None:
            _, task.side, task.middle = STENCILS[spec.operator]
            task.curve, task.beta, task.eps = CURVES.get(spec.curve, 0), spec.beta, spec.eps
            self._ranging = launch("range", weighted, self._ranged), launch("range_finish", weighted, views)
        task.l1_step, task.ssim_step = terms.l1 / x.numel(), 4.0 * terms.ssim / x.numel()
        task.constant = terms.constant
        if terms.ssim:
            task.strip, task.count = strip_of(x, modules.driver.multiprocessors, wanted)
        name, variant = f"{terms.name}_{'gradient' if wanted else 'value'}", plain if terms.ssim else weighted
        self._kernels = launch(name, variant, task.count), launch("finish", PLAIN, 1)
        self._strides: Optional[Tuple[int, ...]] = None
        if wanted:  # dense, where x may be windows that overlap
            dense = torch.empty_like(x, dtype=torch.float32)
            dense = dense if _is_addressable(dense) else dense.contiguous()
            task.of_gradient, self._strides = Strides(*dense.stride()), dense.stride()[-len(self._shape) :]
            blocks = max(1, min(-(-x.numel() // (4 * THREADS)), 16 * modules.driver.multiprocessors))
            self._scale = launch("scale", plain, blocks)

    def compute(
        self, prediction: Tensor, target: Tensor, map_: Optional[Tensor], range_: Optional[Tensor]
    ) -> Tuple[Tensor, Optional[Tensor]]:
        if self._mixed:
            prediction, target = prediction.float(), target.float()
        x = prediction.contiguous() if self._copies[0] else prediction
        y = target.contiguous() if self._copies[1] else target
        task = Task.from_buffer_copy(self._task)
        task.prediction, task.target = x.data_ptr(), y.data_ptr()
        # A copy of a tensor of inference mode; or what a hook of saved tensors, as of torch's save_on_cpu, gives back.
        if x.stride() != self._strides_of_prediction:
            task.of_prediction = Strides(*_batch(x).stride())
        if y.stride() != self._strides_of_target:
            task.of_target = Strides(*_batch(y).stride())
        made = None  # it must live until the last launch, as the map; the allocator keeps the order of one stream
        if map_ is not None:
            map_ = map_.detach().to(torch.float32).contiguous()
            task.map, task.map_view = map_.data_ptr(), map_.numel() > self._pixels[0]
        if self._ranging and (range_ is None or self._ssim):
            # One piece of memory: the range, sums of blocks, and for the streaming pass the responses.
            start = 2 * self._views + 3 * self._ranged
            made = y.new_empty(start + (self._pixels[1] if self._ssim else 0), dtype=torch.float32)
            task.range = task.result = base = made.data_ptr()
            task.partial, task.response = base + 8 * self._views, base + 4 * start if self._ssim else None
            count, task.count = task.count, self._ranged
            self._launch(task, *self._ranging)
            task.count = count
        if self._ranging and range_ is not None:
            if range_.shape != (self._views, 2):
                raise ValueError(f"a range {list(range_.shape)} does not fit images {list(self._shape)}")
            task.range = range_.data_ptr()
        gradient = None
        if self._strides is not None:
            gradient = torch.empty_strided(self._shape, self._strides, dtype=torch.float32, device=x.device)
            task.gradient = gradient.data_ptr()
        partial = x.new_empty(task.count, dtype=torch.float32)
        loss = x.new_empty((), dtype=torch.float32)
        task.partial, task.result = partial.data_ptr(), loss.data_ptr()
        self._launch(task, *self._kernels)
        del made
        return loss, gradient

    def scaled(self, gradient: Tensor, step: Tensor) -> Tensor:
        """Return their product, rounded once, in the images' type."""
        scaled = gradient if self._dtype == torch.float32 else torch.empty_like(gradient, dtype=self._dtype)
        task = Task(gradient=gradient.data_ptr(), scaled=scaled.data_ptr(), step=step.data_ptr())
        task.count = gradient.numel()
        self._launch(task, self._scale)
        return scaled

    def response_range(self, target: Tensor) -> Tensor:
        y, task = target.contiguous() if self._copies[1] else target, Task.from_buffer_copy(self._task)
        result = y.new_empty((self._views, 2), dtype=torch.float32)
        partial = y.new_empty(3 * self._ranged, dtype=torch.float32)
        task.target, task.partial, task.result = y.data_ptr(), partial.data_ptr(), result.data_ptr()
        task.count = self._ranged
        self._launch(task, *self._ranging)
        return result


def strip_of(images: Tensor, multiprocessors: int, wanted: bool) -> Tuple[int, int]:
    """Return how many rows a block of the streaming pass does, and how many blocks there are.

    Every strip repeats the rows above and below it, so strips are long; but all multiprocessors should have work.
    """
    views, channels, height, width = images.shape
    halo = 2 * _REACH if wanted else _REACH + 1
    tiles = -(-width // (THREADS - 2 * halo)) * views * channels
    at_a_time = _BLOCKS_AT_A_TIME * multiprocessors

    def cost(strip: int) -> int:
        return -(-tiles * -(-height // strip) // at_a_time) * (min(strip, height) + 2 * halo)

    strip = min(range(16, 513, 4), key=cost)
    return strip, tiles * -(-height // strip)


def chunks_of(images: Tensor) -> int:
    """Return how many blocks a view gets in a pass that goes pixel by pixel."""
    return -(-images.shape[3] // THREADS) * -(-images.shape[2] // RUN)


def _batch(images: Tensor) -> Tensor:
    return images.unsqueeze(0) if images.dim() == 3 else images


def _is_addressable(images: Tensor) -> bool:
    """Return whether the kernels can address the planes of images [B, C, H, W]: all strides but huge ones."""
    _, _, row, column = images.stride()
    reach = (images.shape[2] + 31) * row + (images.shape[3] - 1) * column
    return max(row, column, reach) <= _MOST  # rows below the image are computed, not read


BACKEND: Backend = CudaBackend(lambda device: Modules(CudaDriver(device), find_compiler(), BinaryCache(cache_folder())))
