"""The numba rasterizer: projection.py and tiles.py as one differentiable function of torch."""

from __future__ import annotations

from typing import Any, Optional, Tuple

import numba
import numpy as np
import torch
from torch import Tensor

from legs_loss.reference import projection, tiles
from legs_loss.reference.conventions import View


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        scales: Tensor,
        quaternions: Tensor,
        opacities: Tensor,
        sh: Tensor,
        viewspace: Optional[Tensor],
        view: View,
        background: Tensor,
        degree: int,
    ) -> Tuple[Tensor, Tensor]:
        count, workers = len(means), numba.get_num_threads()
        grid = np.array(view.tiles)
        camera = (
            np.array([view.fx, view.fy, view.cx, view.cy, *view.limits]),
            view.world_to_camera,
            view.position,
        )
        splats = np.empty((count, 10))
        depths = np.empty(count, np.float32)
        radii = np.empty(count, np.int32)
        clamped = np.empty((count, 3), np.bool_)
        boxes = np.empty((count, 4), np.int32)
        slots = np.empty(count, np.int64)
        parameters = [_array(tensor) for tensor in (means, scales, quaternions, opacities, sh)]
        projection.project(*parameters, degree, *camera, grid, splats, depths, radii, clamped, boxes, slots)

        first_slots = np.cumsum(slots) - slots
        spans = np.empty(int(slots.sum()), np.int32)
        tiles.find_spans(splats, boxes, slots, first_slots, spans)
        order = tiles.order_by_depth(depths, slots)
        counts = np.zeros(int(grid.prod()), np.int64)
        tiles.count_entries(order, boxes, first_slots, spans, grid, counts, workers)
        ranges = np.concatenate([[0], np.cumsum(counts)])
        entries = np.empty((int(ranges[-1]), tiles.FIELDS), np.float32)
        entry_slots = np.empty(len(entries), np.int64)
        tiles.fill_entries(
            order, splats, boxes, first_slots, spans, grid, ranges[:-1].copy(), entries, entry_slots, workers
        )

        image = torch.empty(3, view.height, view.width)
        tile_order = np.argsort(-counts, kind="stable")  # the fullest first, dealt out to the workers in turn
        ends = np.empty_like(counts)
        work = (tile_order, ranges, ends, entries, entry_slots, spans)
        tiles.render(workers, *work, _array(background), grid, image.numpy())

        radii_tensor = torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(means, scales, quaternions, sh, image)
        ctx.columns = 2 if viewspace is None else viewspace.shape[1]
        ctx.state = (degree, camera, grid, (splats, clamped, boxes, slots, first_slots, spans), work)
        return image, radii_tensor

    @staticmethod
    def backward(ctx: Any, g_image: Tensor, _: Any) -> Tuple[Optional[Tensor], ...]:
        means, scales, quaternions, sh, image = ctx.saved_tensors
        degree, camera, grid, splatted, work = ctx.state
        slot_gradients = np.empty((len(splatted[-1]), tiles.MOMENTS), np.float32)
        tiles.render_backward(numba.get_num_threads(), *work, grid, _array(image), _array(g_image), slot_gradients)
        count = len(means)
        shapes = (means.shape, scales.shape, quaternions.shape, (count, 1), sh.shape, (count, ctx.columns))
        gradients = [torch.empty(shape) for shape in shapes]
        projection.project_backward(
            *[_array(tensor) for tensor in (means, scales, quaternions, sh)],
            degree,
            *camera,
            *splatted,
            slot_gradients,
            np.array([image.shape[2] / 2, image.shape[1] / 2]),
            *[gradient.numpy() for gradient in gradients],
        )
        if not ctx.needs_input_grad[5]:
            gradients[5] = None
        return (*gradients, None, None, None)


def render(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    sh: Tensor,
    view: View,
    background: Tensor,
    sh_degree: int,
    viewspace: Optional[Tensor],
) -> Tuple[Tensor, Tensor]:
    """Image [3, H, W] and radii int32 [N]; arguments as `rasterize` has checked them."""
    return _Rasterize.apply(means, scales, quaternions, opacities, sh, viewspace, view, background, sh_degree)
