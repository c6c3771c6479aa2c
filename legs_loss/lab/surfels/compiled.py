"""Wrap the compiled rasterizer of surfels, projection.py and strips.py, as one differentiable function of torch."""

from __future__ import annotations

from typing import Any, Optional, Tuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.kernels.compiling import in_threads
from legs_loss.lab.rasterizer import harmonics, sorting
from legs_loss.lab.rasterizer.groups import room
from legs_loss.lab.surfels import projection, projection_backward, strips
from legs_loss.lab.surfels.groups import DiscCamera, Discs, Pictures, ProjectedDiscs, Work
from legs_loss.lab.surfels.model import CHANNELS, Surfels, SurfelView

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
        discs = Discs(*(_array(tensor) for tensor in tensors))
        width, height, count = view.width, view.height, len(discs.means)
        camera = DiscCamera(
            degree=view.sh_degree, pose=_array(view.world_to_camera.double()), pixels=_array(view.pixels),
            position=_array(view.position.double()), width=width, height=height,
        )  # fmt: skip
        found = room(ProjectedDiscs, count, projection.SPLAT, projection.EXTENT)
        in_threads(projection.project, -(-count // projection.BLOCK), discs, camera, found, own=harmonics.memory)

        across, down = -(-width // projection.WIDE), -(-height // projection.TALL)
        firsts, reached = sorting.make_slots(found.boxes, found.slots, projection.TALL)
        projection.find_rows(found.extents, found.boxes, found.slots, firsts, across, reached)
        ranges, draws, bands = sorting.sort_entries(found.depths, firsts, reached, across, down)

        image, others = torch.empty(3, height, width), torch.empty(CHANNELS, height, width)
        entries = np.empty((int(ranges[-1]), strips.FIELDS), np.float32)
        work = Work(bands, across, ranges, draws, entries, np.empty(across * down, np.int64))
        kept, background = np.empty((3, height, width), np.float32), _array(view.background)
        pictures = Pictures(image.numpy(), others.numpy(), kept)
        in_threads(strips.render, len(bands), work, found.rows, background, pictures)

        radii_tensor = torch.from_numpy(found.radii)
        ctx.mark_non_differentiable(radii_tensor)
        ctx.save_for_backward(image, others, *[tensor for tensor in given if tensor is not None])
        ctx.discs = discs, camera, (found.rows, found.clamped, firsts)
        ctx.strips = work, background, kept
        return image, others, radii_tensor

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, g_image: Optional[Tensor], g_others: Optional[Tensor], _: Any
    ) -> Tuple[Optional[Tensor], ...]:
        image, others = (_array(tensor) for tensor in ctx.saved_tensors[:2])
        discs, camera, drawn = ctx.discs
        work, background, kept = ctx.strips
        sums = sorting.make_sums(drawn[-1], projection_backward.GRADIENTS)
        of_image = _array(torch.zeros(image.shape) if g_image is None else g_image)
        of_others = None if g_others is None else _array(g_others)
        if of_others is not None and not strips.matters(of_others, others):
            of_others = None
        backward = Pictures(image, others, kept), of_image, of_others, sums.reshape(-1)
        in_threads(strips.render_backward, len(work.bands), work, background, *backward)
        results = [torch.zeros(array.shape) for array in discs]
        viewspace = torch.zeros(len(discs.means), 3)
        blocks = -(-len(discs.means) // projection.BLOCK)
        filled = *drawn, sums, Discs(*(result.numpy() for result in results)), viewspace.numpy()
        in_threads(projection_backward.project_backward, blocks, discs, camera, *filled, own=harmonics.memory)
        wanted = ctx.needs_input_grad
        found = [result if wanted[2 + k] else None for k, result in enumerate(results)]
        return (viewspace if wanted[0] else None, None, *found)


def render(surfels: Surfels, view: SurfelView) -> Tuple[Tensor, Tensor, Tensor]:
    """Return image [3, H, W], the other channels [7, H, W] and radii [N],."""
    s = surfels
    given = (s.means, s.scales, s.quaternions, s.homographies, s.opacities, s.sh, s.colours)
    return _Render.apply(s.viewspace, view, *given)
