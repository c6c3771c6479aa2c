"""Wrap the compiled rasterizer of surfels, projection.py and strips.py, as one differentiable function of torch."""

from __future__ import annotations

from typing import Any, Optional, Tuple

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.reference.rasterizer import sorting
from legs_loss.reference.surfels import projection, projection_backward, strips
from legs_loss.reference.surfels.model import Surfels, SurfelView
from legs_loss.reference.surfels.oracle import CHANNELS, to_pixels

# Means, scales, quaternions, homographies, opacities, harmonics and colours; of those not given, an empty one.
EMPTY = ((0, 3), (0, 2), (0, 4), (0, 9), (0, 1), (0, 1, 3), (0, 3))


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Render(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, viewspace: Optional[Tensor], view: SurfelView, *given: Optional[Tensor]
    ) -> Tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        tensors = tuple(torch.empty(shape) if tensor is None else tensor for tensor, shape in zip(given, EMPTY))
        means, scales, quaternions, homographies, opacities, sh, colours = (_array(tensor) for tensor in tensors)
        width, height, count = view.width, view.height, len(means)
        parameters = (means, scales, quaternions, homographies, opacities, sh, colours)
        camera = (
            view.sh_degree,
            _array(view.world_to_camera.double()),
            _array(to_pixels(view.projection.detach().double(), width, height)),
            _array(view.position.double()),
        )
        splats, extents = (np.empty((count, fields)) for fields in (projection.SPLAT, projection.EXTENT))
        depths, radii, clamped = np.empty(count, np.float32), np.empty(count, np.int32), np.empty((count, 3), np.bool_)
        boxes, slots = np.empty((count, 4), np.int32), np.empty(count, np.int64)
        projection.project(*parameters, *camera, width, height, splats, extents, depths, radii, clamped, boxes, slots)

        across, down = -(-width // projection.WIDE), -(-height // projection.TALL)
        firsts, reached = sorting.make_slots(boxes, slots, projection.TALL)
        projection.find_rows(extents, boxes, slots, firsts, across, reached)
        ranges, draws, bands = sorting.sort_entries(depths, slots, firsts, reached, across, down)

        image, others = torch.empty(3, height, width), torch.empty(CHANNELS, height, width)
        kept, ends = np.empty((3, height, width), np.float32), np.empty(across * down, np.int64)
        entries, background = np.empty((int(ranges[-1]), strips.FIELDS), np.float32), _array(view.background)
        strips.render(
            numba.get_num_threads(), bands, across, ranges, splats, draws, entries, ends, background, image.numpy(),
            others.numpy(), kept,
        )  # fmt: skip

        radii_tensor = torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(image, others, *[tensor for tensor in given if tensor is not None])
        ctx.discs = parameters, camera, (splats, clamped, firsts)
        ctx.strips = (bands, across, ranges, draws, entries, ends, background), kept
        return image, others, radii_tensor

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, g_image: Optional[Tensor], g_others: Optional[Tensor], _: Any
    ) -> Tuple[Optional[Tensor], ...]:
        image, others = (_array(tensor) for tensor in ctx.saved_tensors[:2])
        parameters, camera, discs = ctx.discs
        work, kept = ctx.strips
        sums = sorting.make_sums(discs[-1], projection_backward.GRADIENTS)
        of_image = _array(torch.zeros(image.shape) if g_image is None else g_image)
        of_others = None if g_others is None else _array(g_others)
        if of_others is not None and not strips.matters(of_others, others):
            of_others = None
        strips.render_backward(
            numba.get_num_threads(), *work, image, others, kept, of_image, of_others, sums.reshape(-1)
        )
        results = [torch.empty(array.shape) for array in parameters]
        viewspace = torch.empty(len(parameters[0]), 3)
        half = np.array([image.shape[2] / 2, image.shape[1] / 2])
        projection_backward.project_backward(
            *parameters, *camera, half, *discs, sums, *[result.numpy() for result in (*results, viewspace)]
        )
        wanted = ctx.needs_input_grad
        found = [result if wanted[2 + k] else None for k, result in enumerate(results)]
        return (viewspace if wanted[0] else None, None, *found)


def render(surfels: Surfels, view: SurfelView) -> Tuple[Tensor, Tensor, Tensor]:
    """Return image [3, H, W], the other channels [7, H, W] and radii [N], as the oracle's `render`."""
    s = surfels
    given = (s.means, s.scales, s.quaternions, s.homographies, s.opacities, s.sh, s.colours)
    return _Render.apply(s.viewspace, view, *given)
