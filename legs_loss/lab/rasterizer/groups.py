"""The arguments of the compiled rasterizer's loops over Gaussians: named groups of arrays, with their shapes."""

from __future__ import annotations

from typing import Any, NamedTuple, Optional

import numpy as np

from legs_loss.lab.conventions import DILATION, SQUARE


class Parameters(NamedTuple):
    """N Gaussians, or the gradients to them; float32. A shape is scales and quaternions, or a covariance."""

    means: np.ndarray  # [N, 3]
    scales: Optional[np.ndarray]  # [N, 3]
    quaternions: Optional[np.ndarray]  # [N, 4], wxyz of any length
    opacities: np.ndarray  # [N, 1]
    sh: np.ndarray  # [N, K, 3]
    covariances: Optional[np.ndarray]  # [N, 6]: xx, xy, xz, yy, yz, zz


class GaussianCamera(NamedTuple):
    """The camera that looks at them; float64."""

    degree: int  # of the harmonics, as far as they are used
    intrinsics: np.ndarray  # [6]: fx, fy, cx, cy, the limits of |x / z| and |y / z|
    pose: np.ndarray  # [4, 4], world to camera
    position: np.ndarray  # [3]
    size: np.ndarray  # [2], int64: width and height


class Footprint(NamedTuple):
    """The reach of a splat; the defaults are 3DGS's."""

    dilation: float = DILATION  # pixels^2
    square: float = SQUARE  # standard deviations


class ProjectedGaussians(NamedTuple):
    """The projections of N Gaussians."""

    rows: np.ndarray  # [N, 9], float64: see projection.py
    depths: np.ndarray  # [N], float32
    radii: np.ndarray  # [N], int32: pixels; 0 where none is drawn
    clamped: np.ndarray  # [N, 3], bool: channels held at 0
    boxes: np.ndarray  # [N, 4], int32: of strips across, of rows down
    slots: np.ndarray  # [N], int64: how many strips the box has


def room(kind: Any, count: int, *widths: int) -> Any:
    """Return a group of splats to be filled: rows of so many float64 each, then what all splats have."""
    return kind(
        *(np.empty((count, width)) for width in widths),
        depths=np.empty(count, np.float32),
        radii=np.empty(count, np.int32),
        clamped=np.empty((count, 3), np.bool_),
        boxes=np.empty((count, 4), np.int32),
        slots=np.empty(count, np.int64),
    )
