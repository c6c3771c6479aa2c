"""Photograph -> normalised response, by compiled code where that is worth loading."""

from __future__ import annotations

from typing import Any, Dict, Iterable, Optional, Tuple

import numpy as np
import torch

from legs_loss.kernels.available import BACKENDS
from legs_loss.responses import response, response_levels, scene_levels
from legs_loss.scenes import image_tensor
from legs_loss.scenes.images import row_strips
from legs_loss.spec import WeightSpec

_WORTH_COMPILING = 1 << 20  # values of a photograph; loading numba takes longer than torch does for less


def normalised_map(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return E^ of a photograph uint8 or uint16 [H, W, C] as float16 [H, W]."""
    return normalised_map_and_levels(image, spec)[0]


def normalised_map_and_levels(image: np.ndarray, spec: WeightSpec) -> Tuple[np.ndarray, Dict[str, Any]]:
    """Return E^ of a photograph, and of a spec over the scene the entry's further values: E was low + span * E^."""
    levels: Dict[str, Any] = {}
    strength = response_map(image, spec)
    low, high = strength.amin(), strength.amax()
    span = high - low + spec.eps
    if spec.over == "scene":
        median, strong = response_levels(strength[None], spec).tolist()
        levels = {"low": float(low), "span": float(span), "median": median, "strong": strong}
    height, width = strength.shape
    normalised = np.empty((height, width), np.float16)  # numpy asks for large pages; torch does not
    for rows in row_strips(height, width):  # in place: new memory would have to be mapped
        torch.from_numpy(normalised[rows]).copy_(strength[rows].sub_(low).div_(span))
    return normalised, levels


def response_map(image: np.ndarray, spec: WeightSpec) -> torch.Tensor:
    """Return E of a photograph uint8 or uint16 [H, W, C] as float32 [H, W]."""
    if image.size >= _WORTH_COMPILING and BACKENDS.chosen(torch.device("cpu"), "l1") == "numba":
        from legs_loss.kernels.codes import STENCILS
        from legs_loss.kernels.compiling import said
        from legs_loss.precompute.compiled import photograph_response

        if spec.operator in STENCILS:
            with said("legs precompute", "1 to 5 s"):
                return torch.from_numpy(photograph_response(image, spec))
    return response(image_tensor(image), spec.operator, spec.p, False, spec.smooth)[0]


def levels_of(images: Iterable[torch.Tensor], spec: WeightSpec) -> Optional[torch.Tensor]:
    """Return the levels of a scene's images [C, H, W], [2]; None for a spec that is not normalised over the scene."""
    if spec.over != "scene":
        return None
    strengths = (response(image, spec.operator, spec.p, False, spec.smooth) for image in images)
    return scene_levels(response_levels(strength, spec) for strength in strengths)
