"""The numba rasterizer: projection.py and strips.py as one differentiable function of torch."""

from __future__ import annotations

from typing import Any, Optional, Tuple

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.reference.conventions import View
from legs_loss.reference.rasterizer import projection, strips


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
        size = np.array([view.width, view.height], np.int64)
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
        projection.project(*parameters, degree, *camera, size, splats, depths, radii, clamped, boxes, slots)

        # A slot is a strip in a Gaussian's box of strips; an entry, one that it reaches, sorted by strip and depth.
        first_slots = np.cumsum(slots) - slots
        total = int(slots.sum())
        slot_strips, slot_rows, places = (np.empty(total, np.int32) for _ in range(3))
        across, down = -(-view.width // strips.WIDE), -(-view.height // strips.TALL)
        strips.find_rows(splats, boxes, slots, first_slots, across, slot_strips, slot_rows)
        order = strips.order_by_depth(depths, slots)
        ranges = np.zeros(across * down + 1, np.int64)
        owners, rows = np.empty(total, np.int32), np.empty(total, np.int32)
        strips.sort_slots(order, slots, first_slots, slot_strips, slot_rows, ranges, places, owners, rows)

        image = torch.empty(3, view.height, view.width)
        entries = np.empty((int(ranges[-1]), strips.FIELDS), np.float32)
        ends = np.empty(across * down, np.int64)
        strip_order = np.argsort(-np.diff(ranges), kind="stable")  # the fullest first, dealt out to the workers in turn
        strips.render(
            workers, strip_order, ranges, splats, owners, rows, entries, ends, _array(background), across, image.numpy()
        )

        radii_tensor = torch.from_numpy(radii)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(means, scales, quaternions, opacities, sh, image)
        ctx.columns = 2 if viewspace is None else viewspace.shape[1]
        splatted = (splats, clamped, boxes, slots, first_slots, slot_rows, places)
        ctx.state = (degree, camera, splatted, across, (strip_order, ranges, rows, entries, ends))
        return image, radii_tensor

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, _: Any) -> Tuple[Optional[Tensor], ...]:
        means, scales, quaternions, opacities, sh, image = ctx.saved_tensors
        degree, camera, splatted, across, work = ctx.state
        entry_gradients = np.empty((len(work[3]), strips.MOMENTS), np.float32)
        strips.render_backward(
            numba.get_num_threads(), *work, across, _array(image), _array(g_image), ctx.columns == 4, entry_gradients
        )
        count = len(means)
        shapes = (means.shape, scales.shape, quaternions.shape, opacities.shape, sh.shape, (count, ctx.columns))
        gradients = [torch.empty(shape) for shape in shapes]
        projection.project_backward(
            *[_array(tensor) for tensor in (means, scales, quaternions, opacities, sh)],
            degree,
            *camera,
            *splatted,
            entry_gradients,
            np.array([image.shape[2] / 2, image.shape[1] / 2]),
            *[gradient.numpy() for gradient in gradients],
        )
        viewspace = gradients.pop() if ctx.needs_input_grad[5] else None
        return (*gradients[:5], viewspace, None, None, None)


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
