"""Draw surfels: the arguments are checked here."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.lab.surfels.model import CHANNELS, Surfels, SurfelView


def rasterize_surfels(surfels: Surfels, view: SurfelView) -> Tuple[Tensor, Tensor, Tensor]:
    """Draw surfels as 2D Gaussian Splatting does, differentiable in all their tensors.

    Args:
        surfels: the discs, float32.
        view: the camera. No gradient.

    Returns:
        Image [3, H, W]; radii int32 [N], pixels, 0 for what is not drawn; and depth, alpha, normal x y z, median depth,
        distortion [7, H, W].

    Raises:
        LegsError: shapes that do not fit.

    Source: 2D Gaussian Splatting for Geometrically Accurate Radiance Fields (Huang et al. 2024).
    """
    if not len(surfels.means):  # as upstream: nothing at all, not even the background
        empty = surfels.means.sum() * 0
        image, others = (empty.expand(channels, view.height, view.width) for channels in (3, CHANNELS))
        return image, torch.zeros(0, dtype=torch.int32), others
    _check(surfels, view.sh_degree)
    from legs_loss.lab.surfels.compiled import render

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
    sides = ((3,), (1,), (2,), (4,), (9,), (coefficients, 3), (3,), (3,))  # behind the first, of each field
    wrong = [
        f"{name} {list(tensor.shape)}, expected {[count, *shape]}"
        for name, tensor, shape in zip(Surfels._fields, surfels, sides)
        if tensor is not None and tuple(tensor.shape) != (count, *shape)
    ]
    if wrong:
        raise LegsError(f"surfels of the wrong shape: {'; '.join(wrong)}")
