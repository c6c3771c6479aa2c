"""The operations on a GPU: the loss and its gradient in one pass, differentiable, without waiting for the device.

Backward multiplies by the incoming gradient, which the kernel reads on the device (and changes nothing where it is 1).
"""

from __future__ import annotations

from typing import Any, NamedTuple, Optional, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss.kernels.contract import Weights
from legs_loss.kernels.cuda.launch import THREADS, Task, addressable, chunks_of, strip_of, variant_of
from legs_loss.kernels.cuda.modules import Modules
from legs_loss.kernels.differentiable import differentiable
from legs_loss.spec import WeightSpec

__all__ = ["Shares", "fused_loss", "response_range"]


class Shares(NamedTuple):
    """The loss is l1 * L1 + ssim * SSIM + constant; a term of share 0 is not computed."""

    l1: float
    ssim: float
    constant: float = 0.0


def fused_loss(modules: Modules, prediction: Tensor, target: Tensor, weights: Weights, shares: Shares) -> Tensor:
    """Return a loss of images [C, H, W] or [B, C, H, W], differentiable once in the prediction; float32.

    Images of two different types are computed in float32.
    """
    if prediction.dtype != target.dtype:
        prediction, target = prediction.float(), target.float()
    if prediction.dim() == 3:
        prediction, target = prediction.unsqueeze(0), target.unsqueeze(0)
    settings = weights._replace(map=None, mask=None, range=None)

    def compute(wanted: bool, image: Tensor, constants: Sequence[Optional[Tensor]]) -> Tuple[Tensor, Optional[Tensor]]:
        images, map_, mask, found = constants
        assert images is not None
        given = settings._replace(map=map_, mask=mask, range=found)
        return _loss_and_gradient(modules, image, images.detach(), given, shares, wanted)

    def scale(gradient: Tensor, step: Tensor) -> Tensor:
        return _scaled(modules, gradient, step, dtype)

    dtype = prediction.dtype
    return differentiable(prediction, (target, weights.map, weights.mask, weights.range), compute, scale)


def response_range(modules: Modules, target: Tensor, spec: WeightSpec) -> Tensor:
    """Return the least response of each view, and the greatest less the least: float32 [B, 2]."""
    images = addressable((target.unsqueeze(0) if target.dim() == 3 else target).detach())
    variant = variant_of(images.dtype, spec)
    find, finish = (modules.function(name, variant) for name in ("legs_range", "legs_range_finish"))
    views, task = images.shape[0], Task()
    task.measure(images)
    task.weigh(spec)
    task.show("target", images)
    task.chunks = chunks_of(images, modules.driver.multiprocessors)
    task.count = views * task.chunks
    partial = torch.empty(3, task.count, dtype=torch.float32, device=images.device)
    result = torch.empty(views, 2, dtype=torch.float32, device=images.device)
    task.partial, task.result = partial.data_ptr(), result.data_ptr()
    modules.driver.launch(find, task.count, THREADS, task)
    modules.driver.launch(finish, views, THREADS, task)
    return result


def _loss_and_gradient(
    modules: Modules, prediction: Tensor, target: Tensor, weights: Weights, shares: Shares, wanted: bool
) -> Tuple[Tensor, Optional[Tensor]]:
    x, y = addressable(prediction), addressable(target)
    device, spec = x.device, weights.spec if shares.l1 else None
    term = "l1" if shares.ssim == 0.0 else ("loss" if shares.l1 else "ssim")
    own = modules.function(f"legs_{term}_{'gradient' if wanted else 'value'}", variant_of(x.dtype, spec))
    finish = modules.function("legs_finish", variant_of(torch.float32, None))
    if wanted:
        modules.function("legs_scale", variant_of(x.dtype, None))  # for backward, which a capture may contain alone
    task = Task()
    task.measure(x)
    task.show("prediction", x)
    task.show("target", y)
    task.l1_share, task.ssim_share, task.constant = shares
    # These must live until the launch; the allocator keeps the order of one stream.
    held = _add_weights(task, modules, y, weights, spec) if shares.l1 else []
    gradient = None
    if wanted:
        gradient = addressable(torch.empty_like(x, dtype=torch.float32))  # dense, where x may be windows that overlap
        task.show("gradient", gradient)
    task.strip, blocks = strip_of(x, modules.driver.multiprocessors, wanted)
    if term == "l1":
        task.chunks = chunks_of(x, modules.driver.multiprocessors)
        blocks = task.chunks * task.views
    task.count = blocks
    partial = torch.empty(2, blocks, dtype=torch.float32, device=device)
    loss = torch.empty((), dtype=torch.float32, device=device)
    task.partial, task.result = partial.data_ptr(), loss.data_ptr()
    modules.driver.launch(own, blocks, THREADS, task)
    modules.driver.launch(finish, 1, THREADS, task)
    del held
    return loss, gradient


def _add_weights(task: Task, modules: Modules, y: Tensor, weights: Weights, spec: Optional[WeightSpec]) -> Any:
    held = []
    if spec is not None:
        found = weights.range if weights.range is not None else response_range(modules, y, spec)
        found = found.to(device=y.device, dtype=torch.float32).contiguous()
        if found.shape != (y.shape[0], 2):
            raise ValueError(f"a range {list(found.shape)} does not fit images {list(y.shape)}")
        task.weigh(spec)
        task.range = found.data_ptr()
        held.append(found)
    for name in ("map", "mask"):
        values = getattr(weights, name)
        if values is None:
            continue
        values = values.detach().to(torch.float32).contiguous()
        pixels = y.shape[2] * y.shape[3]
        if values.numel() not in (pixels, pixels * y.shape[0]):
            raise ValueError(f"a {name} {list(values.shape)} does not fit images {list(y.shape)}")
        setattr(task, name, values.data_ptr())
        setattr(task, f"{name}_view", pixels if values.numel() > pixels else 0)
        held.append(values)
        if name == "mask" and weights.renormalise:
            covered = values.mean()
            task.covered = covered.data_ptr()
            held.append(covered)
    return held


def _scaled(modules: Modules, gradient: Tensor, step: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the gradient times the incoming gradient of backward, rounded once, in the prediction's type."""
    step = step.to(torch.float32).contiguous()
    scaled = gradient if dtype == torch.float32 else torch.empty_like(gradient, dtype=dtype)
    task = Task(gradient=gradient.data_ptr(), scaled=scaled.data_ptr(), step=step.data_ptr(), count=gradient.numel())
    blocks = max(1, min(-(-gradient.numel() // (4 * THREADS)), 16 * modules.driver.multiprocessors))
    function = modules.function("legs_scale", variant_of(dtype, None))
    modules.driver.launch(function, blocks, THREADS, task)
    return scaled
