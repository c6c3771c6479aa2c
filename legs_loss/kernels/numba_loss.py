"""The numba backend: the loss, its L1 term or SSIM, and the gradient in one pass over the images, on the CPU."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from typing import Any, ContextManager, FrozenSet, Optional, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.images import check_values
from legs_loss.kernels.codes import CURVES
from legs_loss.kernels.compiling import claimed, compiled, in_threads, multiply_add, part, said
from legs_loss.kernels.contract import Backend, PreparedLoss, Terms
from legs_loss.kernels.numba_response import NO_FLOATS, Images, extremes, operator_of
from legs_loss.kernels.numba_tiles import TILE_HEIGHT, TILE_WIDTH, all_tiles, tile_memory
from legs_loss.kernels.numba_weights import FORMULAS, WeightSource, weights_of_row
from legs_loss.spec import WeightSpec

_ROWS = 16  # of a strip of the L1 alone
_NO_RANGE = np.empty((0, 2), np.float32)


class _NumbaBackend(Backend):
    name = "numba"
    curves: FrozenSet[str] = frozenset(FORMULAS)

    def preparing(self) -> ContextManager[Any]:
        # In somebody's training script: where nobody looks, nothing is said.
        return said("legs-loss", "5 to 15 s") if sys.stderr and sys.stderr.isatty() else nullcontext()

    def prepare(
        self, terms: Terms, spec: Optional[WeightSpec], prediction: Tensor, target: Tensor, wanted: bool
    ) -> PreparedLoss:
        return _NumbaLoss(terms, spec, prediction, wanted)


BACKEND: Backend = _NumbaBackend()


class _NumbaLoss(PreparedLoss):
    """A loss of images of one shape."""

    def __init__(self, terms: Terms, spec: Optional[WeightSpec], prediction: Tensor, wanted: bool) -> None:
        *views, channels, height, width = prediction.shape
        self.terms, self.spec, self.size = terms, spec, prediction.numel()
        self.shape, self.sizes = tuple(prediction.shape), (*(views or [1]), channels, height, width)
        self.wanted = self.size if wanted else 0
        self.eps = np.float32(0.0 if spec is None else spec.eps)
        made = WeightSpec() if spec is None else spec
        curve, beta = 0 if spec is None else CURVES[spec.curve], np.float32(made.beta)
        self.source = WeightSource(curve, beta, _NO_RANGE, operator_of(made), NO_FLOATS, NO_FLOATS)
        self.steps = np.float32(terms.l1 / self.size), np.float32(2.0 * terms.ssim / self.size)  # of halves of slopes
        down, across = -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)
        self.rows, self.tile = partial(np.empty, (3, width), np.float32), partial(tile_memory, -(-height // down))
        self.tiles, self.strips = (self.sizes[0] * down * across, down, across), self.sizes[0] * -(-height // _ROWS)

    def compute(
        self, prediction: Tensor, target: Tensor, map_: Optional[Tensor], range_: Optional[Tensor]
    ) -> Tuple[Tensor, Optional[Tensor]]:
        y = _flat(target)
        images, source = Images(_flat(prediction), y, *self.sizes), self.source
        gradient = np.empty(self.wanted, np.float32)
        if self.spec is not None:
            # The gradient's memory keeps the responses until it is written.
            found = self._range(y, target, gradient) if range_ is None else range_.numpy().copy()
            found[:, 1] = 1 / (found[:, 1] + self.eps)
            source = source._replace(ranges=found, responses=gradient if range_ is None else NO_FLOATS)
        if map_ is not None:
            source = source._replace(map=_flat(map_))
        if self.terms.ssim == 0.0:
            sums = np.empty(self.strips)
            in_threads(all_strips, self.strips, images, source, self.steps[0], gradient, sums, own=self.rows)
            error, similarity = np.add.reduce(sums), 0.0
        else:
            tasks, down, across = self.tiles
            sums = np.zeros((tasks, 2))
            in_threads(all_tiles, tasks, images, down, across, self.steps, source, gradient, sums, own=self.tile)
            error, similarity = np.add.reduce(sums)
        loss = float((self.terms.l1 * error + self.terms.ssim * similarity) / self.size + self.terms.constant)
        made = torch.from_numpy(gradient).reshape(self.shape) if self.wanted else None
        return prediction.new_tensor(loss, dtype=torch.float32), made

    def scaled(self, gradient: Tensor, step: Tensor) -> Tensor:
        return gradient if step.item() == 1.0 else gradient.mul_(step)

    def response_range(self, target: Tensor) -> Tensor:
        return torch.from_numpy(self._range(_flat(target), target))

    def _range(self, flat: np.ndarray, target: Tensor, responses: np.ndarray = NO_FLOATS) -> np.ndarray:
        found = extremes(flat.reshape(self.sizes), self.source.operator, responses)
        if np.add.reduce(found[:, 2]) != 0.0:  # or NaN; overshoots are fine
            check_values(target)
        found[:, 1] -= found[:, 0]
        return found[:, :2].copy()  # of a batch it has gaps, and numba would compile all for such memory once more


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().contiguous().numpy().reshape(-1)


@compiled(fastmath=False)
def all_strips(weights, errors, unused, counter, tasks, images, source, scale, gradient, sums):  # type: ignore[no-untyped-def]
    """Compute the weighted L1 strip by strip, and its gradient if that has a size.

    Args:
        weights, errors, unused: a row's memory each.
        counter, tasks: of `in_threads`; a task is a strip.
        images: an Images.
        source: a WeightSource.
        scale: of the gradient.
        gradient: float32 [B * C * H * W], or empty.
        sums: float64 [B * strips]: the weighted absolute error of each strip is written.
    """
    strips, width = tasks // images.views, images.width
    task = claimed(counter)
    while task < tasks:
        view, strip = task // strips, task % strips
        errors[:] = np.float32(0)
        for row in range(strip * _ROWS, min((strip + 1) * _ROWS, images.height)):
            weights_of_row(images, source, view, row, np.int64(0), width, weights)
            for channel in range(images.channels):
                at = ((view * images.channels + channel) * images.height + row) * width
                out = gradient[at : at + width] if gradient.size > 0 else unused
                _error_row(images.x[at : at + width], images.y[at : at + width], weights, scale, errors, out)
        total = 0.0
        for j in range(width):
            total += errors[j]
        sums[task] = total
        task = claimed(counter)


@part(fastmath=False)
def _error_row(x, y, weight, scale, sums, out):  # type: ignore[no-untyped-def]
    """Add the weighted absolute errors of a row to the sums of its columns; write their gradient."""
    for j in range(x.size):
        sums[j] = multiply_add(weight[j], abs(x[j] - y[j]), sums[j])
        out[j] = scale * weight[j] * (np.float32(x[j] > y[j]) - np.float32(x[j] < y[j]))
