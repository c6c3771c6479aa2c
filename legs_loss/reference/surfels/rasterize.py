"""Draw surfels with one of two rasterizers: the fast one with numba, or the reference with torch."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.reference.surfels.model import Surfels, SurfelView

__all__ = ["rasterize_surfels"]

OTHERS = 7  # channels in addition to the image's


def rasterize_surfels(surfels: Surfels, view: SurfelView, backend: str = "numba") -> Tuple[Tensor, Tensor, Tensor]:
    """Draw surfels as 2D Gaussian Splatting does, differentiable in all their tensors.

    Args:
        surfels: the discs, float32 for "numba".
        view: the camera. No gradient.
        backend: "numba", or "torch": the oracle, slow, in any floating type.

    Returns:
        Image [3, H, W]; radii int32 [N], pixels, 0 for what is not drawn; and depth, alpha, normal x y z, median depth,
        distortion [7, H, W].

    Raises:
        LegsError: shapes that do not fit.

    Source: 2D Gaussian Splatting for Geometrically Accurate Radiance Fields (Huang et al. 2024).
    """
    if not len(surfels.means):  # as upstream: nothing at all, not even the background
        empty = surfels.means.sum() * 0
        image, others = (empty.expand(channels, view.height, view.width) for channels in (3, OTHERS))
        return image, torch.zeros(0, dtype=torch.int32), others
    _check(surfels, view.sh_degree)
    if backend == "torch":
        from legs_loss.reference.surfels.oracle import render
    else:
        from legs_loss.reference.surfels.compiled import render
    image, others, radii = render(surfels, view)
    return image, radii, others


def _check(surfels: Surfels, degree: int) -> None:
    if (surfels.sh is None) == (surfels.colours is None):
        raise LegsError("surfels need either sh or colours")
    shaped = surfels.scales is not None, surfels.quaternions is not None, surfels.homographies is not None
    if shaped not in ((True, True, False), (False, False, True)):
        raise LegsError("surfels need either scales and quaternions or homographies")
    count, coefficients = len(surfels.means), 0 if surfels.sh is None else surfels.sh.shape[1]
    if surfels.sh is not None and coefficients < (degree + 1) ** 2:
        raise LegsError(f"sh_degree {degree} needs {(degree + 1) ** 2} coefficients; sh has {coefficients}")
    expected = (
        (count, 3),
        (count, 1),
        (count, 2),
        (count, 4),
        (count, 9),
        (count, coefficients, 3),
        (count, 3),
        (count, 3),
    )
    wrong = [
        f"{name} {list(tensor.shape)}, expected {list(shape)}"
        for name, tensor, shape in zip(Surfels._fields, surfels, expected)
        if tensor is not None and tuple(tensor.shape) != shape
    ]
    if wrong:
        raise LegsError(f"surfels of the wrong shape: {'; '.join(wrong)}")
