"""Draw Gaussians as 3DGS does: the arguments are checked here."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Optional, Sequence, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError, require
from legs_loss.lab.conventions import Pinhole


class Rendering(NamedTuple):
    """The result of `rasterize`."""

    image: Tensor  # [3, H, W]
    radii: Tensor  # [N] int32, pixels; 0: the Gaussian touches no tile of this image


def rasterize(
    means: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    opacities: Tensor,
    sh: Tensor,
    camera: Any,
    background: Union[Tensor, Sequence[float]],
    sh_degree: int,
    viewspace: Optional[Tensor] = None,
) -> Rendering:
    """Draw 3D Gaussians as 3DGS does, differentiable in all five tensors, float32 on the CPU.

    Args:
        means: [N, 3], world units.
        scales: [N, 3], activated: standard deviations along the Gaussian's axes, world units.
        quaternions: [N, 4] wxyz, of any length but 0; normalised here.
        opacities: [N, 1], activated, in [0, 1].
        sh: [N, K, 3], K >= (sh_degree + 1)^2; only the first (sh_degree + 1)^2 coefficients are used.
        camera: a pinhole camera: width, height, fx, fy, cx, cy in pixels, world_to_camera [4, 4]
            (`legs_loss.scenes.Camera`). No gradient.
        background: 3 numbers, RGB. No gradient.
        sh_degree: 0 to 3.
        viewspace: an optional leaf of zeros, [N, 2] or [N, 4]: after backward its gradient holds, in columns 1 and 2,
            the gradient with respect to the splat's centre in pixels times half the image's width and height (3DGS's
            units, for densification); in columns 3 and 4 the sums over the pixels of the absolute values of the same.

    Returns:
        `Rendering(image [3, H, W], radii int32 [N])`.

    Raises:
        LegsError: shapes, types or values that cannot be drawn, and a missing numba.

    Examples:
        >>> from types import SimpleNamespace
        >>> camera = SimpleNamespace(width=3, height=3, fx=3.0, fy=3.0, cx=1.5, cy=1.5, world_to_camera=np.eye(4))
        >>> one = torch.ones(1, 1)
        >>> image, radii = rasterize(
        ...     torch.tensor([[0.0, 0.0, 1.0]]), torch.full((1, 3), 0.1), torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     0.5 * one, torch.zeros(1, 1, 3), camera, (0, 0, 0), sh_degree=0)
        >>> image[0, 1, 1].item(), radii.tolist()  # the centre: opacity 0.5 times the gray of zero coefficients, 0.5
        (0.25, [3])
    """
    tensors = {"means": means, "scales": scales, "quaternions": quaternions, "opacities": opacities, "sh": sh}
    _check_shapes(tensors, sh_degree, viewspace)
    view = _check_camera(camera)
    background = torch.as_tensor(background, dtype=means.dtype, device=means.device).detach()
    if tuple(background.shape) != (3,):
        raise LegsError(f"background has shape {tuple(background.shape)}; pass 3 numbers, red, green and blue")
    _check_values(tensors, background)
    require("the rasterizer", "cpu", "numba")
    from legs_loss.lab.rasterizer import compiled

    given = compiled.Tensors(means, scales, quaternions, opacities, sh, None, viewspace)
    return Rendering(*compiled.attach(compiled.draw(given, view, background, sh_degree), given))


def _check_shapes(tensors: Any, sh_degree: int, viewspace: Optional[Tensor]) -> None:
    shapes = ", ".join(f"{name} {list(tensor.shape)}" for name, tensor in tensors.items())
    if sh_degree not in (0, 1, 2, 3):
        raise LegsError(f"sh_degree is {sh_degree!r}; it must be 0, 1, 2 or 3")
    count = tensors["means"].shape[0] if tensors["means"].dim() else 0
    sh = tensors["sh"]
    coefficients = sh.shape[1] if sh.dim() == 3 else 0
    sides = {"means": (3,), "scales": (3,), "quaternions": (4,), "opacities": (1,), "sh": (coefficients, 3)}
    wrong = [name for name, side in sides.items() if tuple(tensors[name].shape) != (count, *side)]
    if wrong:
        raise LegsError(
            f"{' and '.join(wrong)} of the wrong shape among {shapes}; "
            "expected means [N, 3], scales [N, 3], quaternions [N, 4], opacities [N, 1], sh [N, K, 3]"
        )
    if coefficients < (sh_degree + 1) ** 2:
        raise LegsError(
            f"sh_degree {sh_degree} needs K >= {(sh_degree + 1) ** 2} coefficients; sh has {coefficients}: {shapes}"
        )
    if viewspace is not None and tuple(viewspace.shape) not in ((count, 2), (count, 4)):
        raise LegsError(f"viewspace has shape {list(viewspace.shape)}; expected [{count}, 2] or [{count}, 4]: {shapes}")
    for name, tensor in {**tensors, "viewspace": tensors["means"] if viewspace is None else viewspace}.items():
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise LegsError(f"{name} is {tensor.dtype} on {tensor.device}; the rasterizer takes float32 on the CPU")


def _check_values(tensors: Any, background: Tensor) -> None:
    for name, tensor in [*tensors.items(), ("background", background)]:
        if not _finite(tensor.detach()):
            rows = torch.nonzero(~torch.isfinite(tensor.detach().reshape(len(tensor), -1)).all(1))[:, 0]
            raise LegsError(
                f"{name} {list(tensor.shape)} holds NaN or infinity in {len(rows)} of its {len(tensor)} rows, "
                f"first in row {int(rows[0])}"
            )


def _finite(tensor: Tensor) -> bool:
    # A sum is finite whenever everything is (overflow apart), and far cheaper than a mask of the whole.
    return math.isfinite(float(tensor.sum())) or bool(torch.isfinite(tensor).all())


def _check_camera(camera: Any) -> Pinhole:
    matrix = np.asarray(camera.world_to_camera)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise LegsError(f"world_to_camera must be a finite [4, 4] matrix; found shape {list(matrix.shape)}")
    try:
        view = Pinhole.from_camera(camera)
    except np.linalg.LinAlgError:
        raise LegsError("world_to_camera cannot be inverted: its upper left 3x3 must be a rotation") from None
    if view.width < 1 or view.height < 1 or not (view.fx > 0 and view.fy > 0):
        raise LegsError(
            "the camera must have a size of at least 1x1 and positive focal lengths; "
            f"found {view.width}x{view.height}, fx {view.fx}, fy {view.fy}"
        )
    return view
