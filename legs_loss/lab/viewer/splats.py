"""Gaussians as viser draws them, and a test which of them are left of a line on the screen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legs_loss.lab.conventions import SH_C0
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.rasterizer import rotations

__all__ = ["Splats", "left_of", "splats"]

_FARTHEST = 1e9
_LARGEST = float(np.finfo(np.float16).max)  # viser sends covariances as float16


class Splats(NamedTuple):
    """Arguments of viser, float32: centers [N, 3], covariances [N, 3, 3], rgbs [N, 3], opacities [N, 1] in [0, 1]."""

    centers: np.ndarray
    covariances: np.ndarray
    rgbs: np.ndarray
    opacities: np.ndarray


def splats(gaussians: Gaussians) -> Splats:
    """Return Gaussians for viser. Colours are of degree 0: they do not depend on the direction.

    Those that are nowhere, or too far or too large to be drawn (infinite in float16), are left out.
    """
    axes = rotations(gaussians.quaternions) * gaussians.scales[:, None, :]
    colours = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    parts = (gaussians.means, axes @ axes.transpose(1, 2), colours, gaussians.opacities)
    found = [part.detach().float().numpy() for part in parts]
    drawn = np.abs(found[0]).max(axis=1) < _FARTHEST
    for part in found[1:]:
        drawn &= np.abs(part).reshape(len(part), -1).max(axis=1) < _LARGEST  # of NaN, too, this is false
    return Splats(*(part[drawn] for part in found))


def left_of(
    centers: np.ndarray, rotation: np.ndarray, position: np.ndarray, fov: float, aspect: float, share: float
) -> np.ndarray:
    """Return which points lie left of a vertical line on the screen, bool [N].

    Args:
        centers: [N, 3].
        rotation: [3, 3], of the camera's axes (x right, y down, z forward) in the world.
        position: of the camera, [3].
        fov: vertical, in radians.
        aspect: width by height.
        share: of the screen's width that is left of the line, in [0, 1].

    Examples:
        >>> points = np.array([[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0]])
        >>> left_of(points, np.eye(3), np.zeros(3), 1.0, 1.0, 0.5).tolist()
        [True, False]
    """
    seen = (centers - position) @ rotation
    edge = (2 * share - 1) * np.tan(fov / 2) * aspect
    return seen[:, 0] < edge * np.maximum(seen[:, 2], 1e-6)
