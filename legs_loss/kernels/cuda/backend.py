"""The backend for CUDA: what each kernel is given (``struct Task`` of legs.cu), and the operations that launch them.

Nothing waits for the device. Backward multiplies by the incoming gradient, which the kernel reads on the device (and
changes nothing where it is 1). What depends on shapes, strides, types and settings alone is worked out once, in a plan.
"""

from __future__ import annotations

import ctypes
import threading
from typing import Any, Callable, Dict, FrozenSet, NamedTuple, Optional, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss.kernels.codes import CURVES, NORMS, STENCILS
from legs_loss.kernels.contract import Backend
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.modules import FORMULAS, PLAIN, BinaryCache, Modules, Variant, cache_folder
from legs_loss.kernels.cuda.nvrtc import find_compiler
from legs_loss.kernels.differentiable import differentiable
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

__all__ = [
    "BACKEND",
    "THREADS",
    "VALUES",
    "CudaBackend",
    "Layout",
    "Task",
    "chunks_of",
    "strip_of",
]

THREADS = 256
RUN = 8  # rows of a thread of the pixelwise passes
VALUES = {torch.float32: 0, torch.float16: 1, torch.bfloat16: 2}

_REACH = 5  # of SSIM's window
_BLOCKS_AT_A_TIME = 2  # of a multiprocessor: 128 registers a thread
_MOST = 2**31 - 1
_PLANS = 256  # of a device; a codebase with more shapes of images begins again


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
        *((name, ctypes.c_void_p) for name in ("result", "map", "range", "response")),
        *((name, Layout) for name in ("of_prediction", "of_target", "of_gradient")),
        ("count", ctypes.c_longlong),
        *((name, ctypes.c_int) for name in ("views", "channels", "height", "width", "strip", "curve", "chunks")),
        ("map_view", ctypes.c_int),
        *((name, ctypes.c_float) for name in ("side", "middle", "beta", "eps", "l1_step", "ssim_step", "constant")),
    ]


class Shares(NamedTuple):
    """The loss is l1 * L1 + ssim * SSIM + constant; a term of share 0 is not computed."""

    l1: float
    ssim: float
    constant: float = 0.0


class CudaBackend(Backend):
    """The operations on every CUDA device; its kernels are loaded when a device is first met.

    Args:
        open_device: makes the kernels of a device.
    """

    name = "cuda"
    offers: FrozenSet[str] = frozenset({"loss", "l1", "ssim"})
    most_channels = 1 << 16
    operators: FrozenSet[str] = frozenset(STENCILS)
    norms: FrozenSet[float] = frozenset(NORMS)
    curves: FrozenSet[str] = frozenset(FORMULAS)

    def __init__(self, open_device: Callable[[torch.device], Modules]) -> None:
        self._open = open_device
        self._devices: Dict[torch.device, _Device] = {}
        self._lock = threading.Lock()

    def response_range(self, target: Tensor, spec: WeightSpec) -> Tensor:
        """Return each view's least response and the span."""
        return self._of(target).response_range(_batch(target.detach()), spec)

    def loss(self, prediction: Tensor, target: Tensor, weights: Weights, lambda_dssim: float) -> Tensor:
        """Return the whole loss."""
        shares = Shares(1.0 - lambda_dssim, -lambda_dssim, lambda_dssim)
        return self._of(target).fused_loss(prediction, target, weights, shares)

    def weighted_l1(self, prediction: Tensor, target: Tensor, weights: Weights) -> Tensor:
        """Return the weighted L1."""
        return self._of(target).fused_loss(prediction, target, weights, Shares(1.0, 0.0))

    def ssim(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the mean SSIM."""
        return self._of(target).fused_loss(prediction, target, Weights(), Shares(0.0, 1.0))

    def _of(self, images: Tensor) -> _Device:
        device = self._devices.get(images.device)
        if device is None:
            with self._lock:
                device = self._devices.get(images.device) or _Device(self._open(images.device))
                self._devices[images.device] = device
        return device


_Launch = Tuple[Any, int, int]  # a kernel, its blocks and threads


class _Plan(NamedTuple):
    """The launches of an operation, prepared: all but the addresses.

    Attributes:
        task: their argument; its count is of the sums that ``kernels`` add up.
        kernels: the operation, and what adds up its blocks.
        ranging: those that make responses and range, where the weights come from the target.
        ranged: the blocks of these.
        copies: whether prediction and target must be made contiguous first: strides that the kernels cannot address.
        gradient: the gradient's strides, or None where none is wanted.
    """

    task: Task
    kernels: Tuple[_Launch, ...]
    ranging: Tuple[_Launch, ...]
    ranged: int
    copies: Tuple[bool, bool]
    gradient: Optional[Tuple[int, ...]]


class _Device:
    """The operations on one device."""

    def __init__(self, modules: Modules) -> None:
        self._modules = modules
        self._launch = modules.driver.launch
        self._plans: Dict[Any, _Plan] = {}

    def fused_loss(self, prediction: Tensor, target: Tensor, weights: Weights, shares: Shares) -> Tensor:
        """Return a loss of images [C, H, W] or [B, C, H, W], differentiable once in the prediction; float32.

        Images of two different types are computed in float32.
        """
        if prediction.dtype != target.dtype:
            prediction, target = prediction.float(), target.float()
        dtype = prediction.dtype

        def compute(wanted: bool, x: Tensor, constants: Sequence[Optional[Tensor]]) -> Tuple[Tensor, Optional[Tensor]]:
            y, map_, found = constants
            assert y is not None
            given = Weights(weights.spec, found, map_)
            loss, gradient = self._loss_and_gradient(_batch(x), _batch(y.detach()), given, shares, wanted)
            return loss, gradient[0] if gradient is not None and x.dim() == 3 else gradient

        def scale(gradient: Tensor, step: Tensor) -> Tensor:
            return self._scaled(gradient, step, dtype)

        return differentiable(prediction, (target, weights.map, weights.range), compute, scale)

    def response_range(self, y: Tensor, spec: WeightSpec) -> Tensor:
        """Return the least response of each view of [B, C, H, W], and max - min: float32 [B, 2]."""
        key = (y.shape, y.stride(), y.dtype, spec)
        plan = self._plans.get(key) or self._keep(key, self._plan_of(y, y, spec, None, False))
        y = y.contiguous() if plan.copies[1] else y
        task = Task.from_buffer_copy(plan.task)
        result = y.new_empty((y.shape[0], 2), dtype=torch.float32)
        partial = y.new_empty(3 * plan.ranged, dtype=torch.float32)
        task.target, task.partial, task.result = y.data_ptr(), partial.data_ptr(), result.data_ptr()
        task.count = plan.ranged
        self._launch(task, *plan.ranging)
        return result

    def _loss_and_gradient(
        self, x: Tensor, y: Tensor, weights: Weights, shares: Shares, wanted: bool
    ) -> Tuple[Tensor, Optional[Tensor]]:
        spec = weights.spec if shares.l1 else None
        key = (x.shape, x.stride(), y.stride(), x.dtype, wanted, shares, spec)
        plan = self._plans.get(key) or self._keep(key, self._plan_of(x, y, spec, shares, wanted))
        x, y = (images.contiguous() if copied else images for images, copied in zip((x, y), plan.copies))
        task = Task.from_buffer_copy(plan.task)
        task.prediction, task.target = x.data_ptr(), y.data_ptr()
        # What is held must live until the last launch; the allocator keeps the order of one stream.
        held = [self._add_map(task, y, weights), self._add_range(task, y, weights, plan, shares)] if shares.l1 else []
        gradient = None
        if plan.gradient is not None:
            gradient = torch.empty_strided(x.shape, plan.gradient, dtype=torch.float32, device=x.device)
            task.gradient = gradient.data_ptr()
        partial = x.new_empty(plan.task.count, dtype=torch.float32)
        loss = x.new_empty((), dtype=torch.float32)
        task.partial, task.result = partial.data_ptr(), loss.data_ptr()
        self._launch(task, *plan.kernels)
        del held
        return loss, gradient

    def _add_range(self, task: Task, y: Tensor, weights: Weights, plan: _Plan, shares: Shares) -> Sequence[Tensor]:
        """Set the range of a task's weights, for the streaming pass the responses, too; return their memory."""
        if not plan.ranging:
            return ()
        views, _, height, width = y.shape
        given, made = weights.range, None
        if given is not None:
            if given.shape != (views, 2):
                raise ValueError(f"a range {list(given.shape)} does not fit images {list(y.shape)}")
            given = given.to(device=y.device, dtype=torch.float32).contiguous()
        if given is None or shares.ssim:  # one piece of memory: the range, sums of blocks, responses
            start = 2 * views + 3 * plan.ranged
            made = y.new_empty(start + (views * height * width if shares.ssim else 0), dtype=torch.float32)
            base = made.data_ptr()
            task.range, task.result, task.partial = base, base, base + 8 * views
            task.response = base + 4 * start if shares.ssim else None
            count, task.count = task.count, plan.ranged
            self._launch(task, *plan.ranging)
            task.count = count
        if given is not None:
            task.range = given.data_ptr()
        return [values for values in (given, made) if values is not None]

    def _add_map(self, task: Task, y: Tensor, weights: Weights) -> Optional[Tensor]:
        """Set the map of a task's weights; return its memory."""
        if weights.map is None:
            return None
        views, _, height, width = y.shape
        if weights.map.numel() not in (height * width, views * height * width):
            raise ValueError(f"weights {list(weights.map.shape)} do not fit images {list(y.shape)}")
        plane = weights.map.detach().to(torch.float32).reshape(-1, height, width).contiguous()
        task.map, task.map_view = plane.data_ptr(), plane.shape[0] > 1
        return plane

    def _scaled(self, gradient: Tensor, step: Tensor, dtype: torch.dtype) -> Tensor:
        """Return the gradient times the incoming gradient of backward, rounded once, in the prediction's type."""
        step = step.to(torch.float32).contiguous()
        scaled = gradient if dtype == torch.float32 else torch.empty_like(gradient, dtype=dtype)
        count = gradient.numel()
        task = Task(gradient=gradient.data_ptr(), scaled=scaled.data_ptr(), step=step.data_ptr(), count=count)
        blocks = max(1, min(-(-count // (4 * THREADS)), 16 * self._modules.driver.multiprocessors))
        self._launch(task, (self._modules.function("legs_scale", variant_of(dtype, None)), blocks, THREADS))
        return scaled

    def _keep(self, key: Any, plan: _Plan) -> _Plan:
        if len(self._plans) >= _PLANS:
            self._plans.clear()
        self._plans[key] = plan
        return plan

    def _plan_of(
        self, x: Tensor, y: Tensor, spec: Optional[WeightSpec], shares: Optional[Shares], wanted: bool
    ) -> _Plan:
        """Return the plan of a loss, or without shares of the range alone."""
        modules, plain, weighted = self._modules, variant_of(x.dtype, None), variant_of(x.dtype, spec)
        modules.load(weighted, plain, PLAIN)  # backward's too, which a capture may contain alone
        copies = (not _is_addressable(x), not _is_addressable(y))
        task = _task_of(x, spec)
        task.of_prediction = _layout_of(x.contiguous() if copies[0] else x)
        task.of_target = _layout_of(y.contiguous() if copies[1] else y)
        task.chunks = chunks_of(x)
        ranged = task.count = task.chunks * task.views

        def launch(name: str, variant: Variant, blocks: int) -> _Launch:
            return modules.function(f"legs_{name}", variant), blocks, THREADS

        kernels: Tuple[_Launch, ...] = ()
        ranging = kernels
        if spec is not None:
            ranging = launch("range", weighted, ranged), launch("range_finish", weighted, task.views)
        if shares is not None:
            task.l1_step, task.ssim_step = shares.l1 / x.numel(), 4.0 * shares.ssim / x.numel()
            task.constant = shares.constant
            term = "l1" if shares.ssim == 0.0 else ("loss" if shares.l1 else "ssim")
            if term != "l1":
                task.strip, task.count = strip_of(x, modules.driver.multiprocessors, wanted)
            own = launch(f"{term}_{'gradient' if wanted else 'value'}", weighted if term == "l1" else plain, task.count)
            kernels = own, launch("finish", PLAIN, 1)
        strides = None
        if wanted:  # dense, where x may be windows that overlap
            dense = torch.empty_like(x, dtype=torch.float32)
            dense = dense if _is_addressable(dense) else dense.contiguous()
            task.of_gradient, strides = _layout_of(dense), dense.stride()
        return _Plan(task, kernels, ranging, ranged, copies, strides)


def variant_of(dtype: torch.dtype, spec: Optional[WeightSpec]) -> Variant:
    """Return which variant of the kernels computes images of a type with the weights of a spec, or of a map or none."""
    if spec is None:
        return Variant(VALUES[dtype])
    return Variant(VALUES[dtype], STENCILS[spec.operator][0], NORMS[spec.p])


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


def _task_of(images: Tensor, spec: Optional[WeightSpec]) -> Task:
    """Return a task with the size of images [B, C, H, W] and the settings of a spec's weights."""
    views, channels, height, width = images.shape
    task = Task(views=views, channels=channels, height=height, width=width)
    if spec is not None:
        _, task.side, task.middle = STENCILS[spec.operator]
        task.curve, task.beta, task.eps = CURVES.get(spec.curve, 0), spec.beta, spec.eps
    return task


def _layout_of(images: Tensor) -> Layout:
    return Layout(*images.stride())


def _is_addressable(images: Tensor) -> bool:
    """Return whether the kernels can address the planes of images [B, C, H, W]: all strides but huge ones."""
    _, _, row, column = images.stride()
    reach = (images.shape[2] + 31) * row + (images.shape[3] - 1) * column
    return max(row, column, reach) <= _MOST  # rows below the image are computed, not read


def _open(device: torch.device) -> Modules:
    return Modules(CudaDriver(device), find_compiler(), BinaryCache(cache_folder()))


BACKEND: Backend = CudaBackend(_open)
