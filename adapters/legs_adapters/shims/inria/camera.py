"""Read a pinhole camera from the settings that Inria's family of rasterizers takes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, Optional

import numpy as np

from legs_adapters.shims.missing import MissingShim
from legs_loss.lab.rasterizer import Pinhole

__all__ = ["pinhole"]

TOLERANCE = 1e-3  # pixels, and world units: float32 matrices give a camera's numbers to this precision


def pinhole(settings: Any, module: str) -> Pinhole:
    """Return the camera of a `GaussianRasterizationSettings`.

    Its matrices are transposed: points are rows. projmatrix is world to clip space, so that the projection alone is
    inverse(viewmatrix) @ projmatrix; an off-centre principal point is in its third row.

    Raises:
        MissingShim: the matrices, tangents and campos are not those of one pinhole camera.
    """
    view, full = matrix(settings.viewmatrix), matrix(settings.projmatrix)
    width, height = int(settings.image_width), int(settings.image_height)
    fx, fy = width / (2 * float(settings.tanfovx)), height / (2 * float(settings.tanfovy))
    camera = _pinhole(view, full, width, height, fx, fy)
    if camera is None:
        raise MissingShim(module, "GaussianRasterizer", "projmatrix is not that of a pinhole camera with tanfovx")
    campos = getattr(settings, "campos", None)
    if campos is not None:
        centre = -np.linalg.solve(camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3])
        given = np.asarray(campos.detach().cpu().numpy(), np.float64).reshape(-1)[:3]
        if np.abs(centre - given).max() > TOLERANCE * max(1.0, float(np.abs(centre).max())):
            raise MissingShim(module, "GaussianRasterizer", f"campos {given} is not viewmatrix's centre {centre}")
    return Pinhole.from_camera(camera)


def matrix(tensor: Any) -> np.ndarray:
    """Return [4, 4] float64, from [4, 4] or [1, 4, 4]."""
    return np.asarray(tensor.detach().cpu().numpy(), np.float64).reshape(4, 4)


def _pinhole(
    view: np.ndarray, full: np.ndarray, width: int, height: int, fx: float, fy: float
) -> Optional[SimpleNamespace]:
    projection = np.linalg.solve(view, full)
    x, y, w = projection[:, 0], projection[:, 1], projection[:, 3]
    # u = ((x + 1) W - 1) / 2 in pixels whose centres are integers; the camera's cx counts from the image's edge.
    cx, cy = (x[2] + 1) * width / 2, (y[2] + 1) * height / 2
    scale = np.array([width / 2, height / 2])
    found = np.array([x[0], y[1]]) * scale
    rest = np.array([x[1], x[3], y[0], y[3], w[0], w[1], w[3], w[2] - 1]) * scale.max()
    if np.abs(found - (fx, fy)).max() > TOLERANCE * max(fx, fy) or np.abs(rest).max() > 1:
        return None
    fx, fy = float(found[0]), float(found[1])
    return SimpleNamespace(
        width=width, height=height, fx=fx, fy=fy, cx=float(cx), cy=float(cy), world_to_camera=view.T
    )  # fmt: skip
