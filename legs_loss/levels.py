"""Two levels of each view's response, and the scene's levels computed from them: its noise and its strong contours.

The maximum response of a single image is a poor reference: blur lowers it, which raises the normalised rest; noise
raises all other responses. The medians of two levels over the views of a scene are more robust: the median response,
which is the noise where half of an image is smooth (the estimate of wavelet shrinkage), and a high percentile, a strong
contour. A view out of focus is then weak relative to its scene, and a dead pixel, the maximum, changes neither level.

    E~ = min(max(E - noise_floor * max(m, M), 0) / (S + eps), 1)    m: the view's median, M and S: the scene's levels

Source: this project's own; the median as an estimate of noise, subtracted, is Donoho and Johnstone's soft threshold.
"""

from __future__ import annotations

import math
from typing import Iterable, Optional

import torch
from torch import Tensor

from legs_loss.responses import response
from legs_loss.spec import WeightSpec

__all__ = ["NEEDS_LEVELS", "levels_of", "over_scene", "percentile", "response_levels", "scene_levels"]

NEEDS_LEVELS = (
    "weights that are normalised over the scene need the levels of all its views, which {where}: run legs precompute "
    "SCENE --preset legs-robust, with the training's -r, {then}; or take a preset for single images, such as legs"
)


def response_levels(strength: Tensor, spec: WeightSpec) -> Tensor:
    """Return the median and the ``spec.percentile`` of each response.

    Args:
        strength: E, [1, H, W] or [B, 1, H, W], or channels-last.
        spec: its percentile counts.

    Returns:
        [2] or [B, 2], on the same device; nothing waits for it.

    Examples:
        >>> response_levels(torch.tensor([[[0.0, 1.0, 2.0, 7.0, 9.0]]]), WeightSpec(percentile=80))
        tensor([2., 7.])
    """
    return torch.stack([percentile(strength, 50.0), percentile(strength, spec.percentile)], -1)


def scene_levels(levels: Iterable[Tensor]) -> Tensor:
    """Return the medians over views of their levels, [2].

    >>> scene_levels([torch.tensor([1.0, 8.0]), torch.tensor([2.0, 5.0]), torch.tensor([9.0, 1.0])])
    tensor([2., 5.])
    """
    return torch.stack(list(levels)).nanmedian(0).values


def levels_of(images: Iterable[Tensor], spec: WeightSpec) -> Optional[Tensor]:
    """Return the levels of a scene's images [C, H, W], [2]; None for a spec that is not normalised over the scene."""
    if spec.over != "scene":
        return None
    return scene_levels(
        response_levels(response(image, spec.operator, spec.p, False, spec.smooth), spec) for image in images
    )


def over_scene(strength: Tensor, spec: WeightSpec, scene: Optional[Tensor] = None) -> Tensor:
    """Return the response normalised over its scene, E~ in [0, 1].

    Args:
        strength: E, [1, H, W] or [B, 1, H, W], or channels-last.
        spec: its percentile, noise_floor and eps count.
        scene: the scene's levels, [2]; without them these images are the scene.

    Returns:
        The same shape. A NaN in an image makes all of its map NaN.

    Examples:
        >>> spec = WeightSpec(over="scene", percentile=80, noise_floor=1.0)
        >>> over_scene(torch.tensor([[[0.0, 1.0, 2.0, 7.0, 9.0]]]), spec, torch.tensor([3.0, 10.0]))
        tensor([[[0.0000, 0.0000, 0.0000, 0.4000, 0.6000]]])
    """
    if scene is None:
        scene = scene_levels(response_levels(strength, spec).reshape(-1, 2))
    scene = scene.to(strength)
    # A texture removed by blur must not lower the floor: an image's level counts only above the scene's.
    floor = spec.noise_floor * torch.maximum(percentile(strength, 50.0), scene[0])
    floor = floor.reshape(*floor.shape, 1, 1, 1)
    return ((strength - floor).clamp(min=0.0) / (scene[1] + spec.eps)).clamp(max=1.0)


def percentile(values: Tensor, share: float) -> Tensor:
    """Return a percentile of each map [1, H, W] or [B, 1, H, W] by its nearest rank, [] or [B].

    Not by torch.quantile, which refuses images of more than 16 million pixels. A NaN in a map makes it NaN.
    """
    flat = values.flatten(-3)
    rank = max(1, math.ceil(share / 100.0 * flat.shape[-1]))
    found = flat.kthvalue(rank, dim=-1).values
    return torch.where(flat.sum(-1).isnan(), flat.sum(-1), found)
