"""A scene: views with cameras, and the points to start from."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Callable, Iterator, Optional, Sequence, Tuple

import numpy as np

_SIDE, _LONGEST = 1 << 20, 1e9  # pixels


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    ``fx, fy, cx, cy`` are in pixels. The origin is COLMAP's, the outer corner of the first pixel,
    so a centred camera has ``cx = width / 2``. ``world_to_camera`` is a float64 [4, 4].
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera for the image resized to ``width`` x ``height``.

        >>> camera = Camera(400, 300, 500.0, 500.0, 200.0, 150.0, np.eye(4))
        >>> half = camera.resized(200, 150)
        >>> half.fx, half.cy
        (250.0, 75.0)
        """
        x, y = width / self.width, height / self.height
        return Camera(width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.world_to_camera)


@dataclass(frozen=True, eq=False)
class View:
    """One photograph of a scene.

    ``name`` is the image's path relative to the scene, with forward slashes. ``camera`` is None
    where the scene has none or where ``camera_model`` is not a pinhole; ``split`` is "train",
    "test" or "val" where the scene says so. ``composited``: the field's loader lays this image's
    alpha on the background before it resizes (see :func:`load_training_image`). ``mask`` is the file that the scene
    itself names as this image's mask.
    """

    name: str
    path: Path
    camera: Optional[Camera] = None
    split: Optional[str] = None
    camera_model: Optional[str] = None
    composited: bool = False
    mask: Optional[Path] = None


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with colours: ``xyz`` float32 [N, 3] and ``rgb`` uint8 [N, 3]."""

    xyz: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene on disk: ``kind`` is "colmap", "transforms" or "folder"; views are sorted by name.

    ``images`` is the folder of the photographs, where the scene was read with one; ``notes`` are
    sentences for the user: what was left out, and why.
    """

    root: Path
    kind: str
    views: Tuple[View, ...]
    read_points: Optional[Callable[[], PointCloud]] = None
    images: Optional[str] = None
    notes: Tuple[str, ...] = ()

    @property
    def points(self) -> Optional[PointCloud]:
        """Return COLMAP's points, or None; read from disk at every call, since most users of a scene need none.

        Raises :class:`LegsError` when the file is damaged.
        """
        return None if self.read_points is None else self.read_points()


def is_lens(width: int, height: int, focal: Sequence[float], params: Sequence[float]) -> bool:
    """Return whether a camera can have this size, focal lengths and other parameters, in pixels; NaN it cannot."""
    return 0 < width <= _SIDE and 0 < height <= _SIDE and min(focal) > 0 and bool((np.abs(params) < _LONGEST).all())


def view_names(view: str) -> Iterator[str]:
    """Yield every name that identifies a view.

    They are the trailing parts of its path, with the extension, without it, and up to the first dot of the file's
    name, which is 3DGS's name of the view.

    >>> sorted(view_names("images/0001.small.jpg"))
    ['0001', '0001.small', '0001.small.jpg', 'images/0001', 'images/0001.small', 'images/0001.small.jpg']
    """
    *folders, file = view.split("/")
    for last in {file, os.path.splitext(file)[0], file.split(".")[0] or file}:
        for start in range(len(folders) + 1):
            yield "/".join([*folders[start:], last])
