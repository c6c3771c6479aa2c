"""The numba rasterizer: projection.py, strips.py and projection_backward.py as one differentiable function of torch."""

from __future__ import annotations

from typing import Any, Callable, Dict, List, NamedTuple, Optional, Tuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.kernels.compiling import in_threads
from legs_loss.kernels.compiling import said as said
from legs_loss.lab.conventions import SH_C0, Pinhole
from legs_loss.lab.rasterizer import projection, projection_backward, sorting, strips
from legs_loss.lab.rasterizer.groups import Footprint, GaussianCamera, Parameters, ProjectedGaussians, room

Clip = Callable[..., None]


class Tensors(NamedTuple):
    """The tensors that a drawing is differentiable in.

    ``colours`` [N, 3] in place of ``sh``; ``covariances`` [N, 6] (xx, xy, xz, yy, yz, zz), world units^2, in place of
    ``scales`` and ``quaternions``.
    """

    means: Tensor
    scales: Optional[Tensor]
    quaternions: Optional[Tensor]
    opacities: Tensor
    sh: Optional[Tensor]
    colours: Optional[Tensor]
    viewspace: Optional[Tensor]
    covariances: Optional[Tensor] = None


class Drawing(NamedTuple):
    """The intermediate results of a drawing, for the backward pass and for further results.

    A slot is a strip in a Gaussian's box of strips; an entry, one that it reaches, sorted by strip and depth.
    """

    parameters: Parameters
    camera: GaussianCamera
    splats: np.ndarray
    radii: np.ndarray
    clamped: np.ndarray
    firsts: np.ndarray
    across: int
    bands: np.ndarray
    ranges: np.ndarray
    draws: np.ndarray
    entries: np.ndarray
    ends: np.ndarray
    image: np.ndarray

    def recoloured(self, colours: Tensor, background: np.ndarray) -> Drawing:
        """Return the same splats in other colours [N, 3], as they are: neither harmonics nor held at 0."""
        splats = self.splats.copy()
        splats[:, 6:9] = _array(colours)
        return self._replace(
            parameters=self.parameters._replace(sh=np.zeros((len(splats), 1, 3), np.float32)),
            camera=self.camera._replace(degree=0),
            splats=splats,
            clamped=np.zeros_like(self.clamped),
            entries=np.empty_like(self.entries),
            ends=np.empty_like(self.ends),
            image=np.empty_like(self.image),
        ).blended(background)

    def blended(self, background: np.ndarray) -> Drawing:
        """Fill image, entries and ends."""
        in_threads(
            strips.render, len(self.bands), self.bands, self.across, self.ranges, self.splats, self.draws, self.entries,
            self.ends, background, self.image, own=strips.memory,
        )  # fmt: skip
        return self


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def draw(
    tensors: Tensors,
    view: Pinhole,
    background: Tensor,
    degree: int,
    footprint: Footprint = Footprint(),  # noqa: B008 (immutable)
    clip: Optional[Clip] = None,
) -> Drawing:
    """Draw; no gradient yet (see :func:`attach`).

    ``clip`` may take rows away before they are sorted: it is called with the view's tiles across and down, and with
    splats, boxes, slots, firsts, reached and radii.
    """
    count = len(tensors.means)
    parameters = Parameters(
        means=_array(tensors.means), opacities=_array(tensors.opacities),
        scales=None if tensors.scales is None else _array(tensors.scales),
        quaternions=None if tensors.quaternions is None else _array(tensors.quaternions),
        sh=np.zeros((count, 1, 3), np.float32) if tensors.sh is None else _array(tensors.sh),
        covariances=None if tensors.covariances is None else _array(tensors.covariances),
    )  # fmt: skip
    camera = GaussianCamera(
        degree=0 if tensors.sh is None else degree, pose=view.world_to_camera, position=view.position,
        intrinsics=np.array([view.fx, view.fy, view.cx, view.cy, *view.limits]),
        size=np.array([view.width, view.height], np.int64),
    )  # fmt: skip
    found = room(ProjectedGaussians, count, 9)
    blocks = -(-count // projection.BLOCK)
    in_threads(projection.project, blocks, parameters, camera, footprint, found, own=projection.memory)
    splats, depths, radii, clamped, boxes, slots = found
    if tensors.colours is not None:
        splats[:, 6:9] = _array(tensors.colours)
        clamped[:] = False

    firsts, reached = sorting.make_slots(boxes, slots, strips.TALL)
    across, down = -(-view.width // strips.WIDE), -(-view.height // strips.TALL)
    in_threads(projection.find_rows, blocks, splats, boxes, slots, firsts, across, reached)
    if clip is not None:
        clip(np.array(view.tiles), splats, boxes, slots, firsts, reached, radii)
    ranges, draws, bands = sorting.sort_entries(depths, firsts, reached, across, down)
    return Drawing(
        parameters, camera, splats, radii, clamped, firsts, across, bands, ranges, draws,
        entries=np.empty((int(ranges[-1]), strips.FIELDS), np.float32),
        ends=np.empty(across * down, np.int64),
        image=np.empty((3, view.height, view.width), np.float32),
    ).blended(_array(background))  # fmt: skip


def attach(drawing: Drawing, tensors: Tensors) -> Tuple[Tensor, Tensor]:
    """Return a drawing as image [3, H, W] and radii int32 [N], with the gradient to the tensors it was drawn from."""
    # A colour is 1 / C0 of its constant harmonic, for the backward pass.
    sh = tensors.sh if tensors.colours is None else tensors.colours[:, None] / SH_C0
    return _Attach.apply(drawing, tensors.viewspace, *tensors[:4], sh, tensors.covariances)


class _Attach(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, drawing: Drawing, viewspace: Optional[Tensor], *given: Optional[Tensor]
    ) -> Tuple[Tensor, Tensor]:
        # The returned image may be changed in place; the one for the backward pass may not.
        image, radii = torch.from_numpy(drawing.image.copy()), torch.from_numpy(drawing.radii)
        ctx.mark_non_differentiable(radii)
        # So that torch detects changed inputs, and frees the drawing's arrays after the backward pass.
        large = [name for name, value in drawing._asdict().items() if isinstance(value, np.ndarray) and name != "radii"]
        arrays = (torch.from_numpy(getattr(drawing, name)) for name in large)
        ctx.save_for_backward(*given, *arrays)
        ctx.columns = 2 if viewspace is None else viewspace.shape[1]
        nothing: Dict[str, Any] = dict.fromkeys(large)
        ctx.large, ctx.drawing = large, drawing._replace(**nothing)
        return image, radii

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_image: Tensor, _: Any) -> Tuple[Optional[Tensor], ...]:
        arrays = (tensor.numpy() for tensor in ctx.saved_tensors[-len(ctx.large) :])
        it: Drawing = ctx.drawing._replace(**dict(zip(ctx.large, arrays)))
        moments = strips.ABSOLUTE_MOMENTS if ctx.columns == 4 else strips.MOMENTS
        sums = sorting.make_sums(it.firsts, moments)
        in_threads(
            strips.render_backward, len(it.bands), it.bands, it.across, it.ranges, it.draws, it.entries, it.ends,
            it.image, _array(g_image), moments, sums.reshape(-1), own=strips.memory,
        )  # fmt: skip
        shapes = [(len(it.radii), ctx.columns), *(None if array is None else array.shape for array in it.parameters)]
        gradients = [None if shape is None else torch.empty(shape) for shape in shapes]
        filled: List[Any] = [None if gradient is None else gradient.numpy() for gradient in gradients]
        in_threads(
            projection_backward.project_backward, -(-len(it.radii) // projection.BLOCK), it.parameters, it.camera,
            it.splats, it.clamped, it.firsts, sums, Parameters(*filled[1:]), filled[0], own=projection.memory,
        )  # fmt: skip
        found = [gradient if wanted else None for gradient, wanted in zip(gradients, ctx.needs_input_grad[1:])]
        return (None, *found)
