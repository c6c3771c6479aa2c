"""The arguments of the compiled loops over surfels: named groups of arrays, with their shapes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Discs(NamedTuple):
    """N discs, or the gradients to them; float32. What was not given has no rows."""

    means: np.ndarray  # [N, 3]
    scales: np.ndarray  # [N, 2]
    quaternions: np.ndarray  # [N, 4]
    homographies: np.ndarray  # [N, 9], in place of scales and quaternions
    opacities: np.ndarray  # [N, 1]
    sh: np.ndarray  # [N, K, 3]
    colours: np.ndarray  # [N, 3], in place of sh


class DiscCamera(NamedTuple):
    """The camera that looks at them; float64."""

    degree: int  # of the harmonics
    pose: np.ndarray  # [4, 4], world to camera, for points that are rows
    pixels: np.ndarray  # [4, 3], world to homogeneous pixels, likewise
    position: np.ndarray  # [3]
    width: int  # of the image
    height: int


class ProjectedDiscs(NamedTuple):
    """The projections of N discs; the fields of a row are in projection.py."""

    rows: np.ndarray  # [N, SPLAT], float64
    extents: np.ndarray  # [N, EXTENT], float64
    depths: np.ndarray  # [N], float32
    radii: np.ndarray  # [N], int32: pixels; 0 where none is drawn
    clamped: np.ndarray  # [N, 3], bool: channels held at 0
    boxes: np.ndarray  # [N, 4], int32: of strips across, of rows down
    slots: np.ndarray  # [N], int64: how many strips the box has


class Work(NamedTuple):
    """The discs that each strip draws, front to back (sorting.py), and what is kept of them."""

    bands: np.ndarray  # [turns, 2]: the strips that a thread takes at a time
    across: int  # strips
    ranges: np.ndarray  # [strips + 1]: each strip's entries
    draws: np.ndarray  # [entries, 3]
    entries: np.ndarray  # [entries, SPLAT], float32
    ends: np.ndarray  # [strips]: behind the last entry that matters


class Pictures(NamedTuple):
    """The images that are drawn; float32."""

    image: np.ndarray  # [3, H, W]
    others: np.ndarray  # [7, H, W]
    kept: np.ndarray  # [3, H, W]: what only the gradient needs
