"""The numbers that make a rasterizer 3DGS's (Kerbl et al. 2023), each in one place for it and its oracle."""

from __future__ import annotations

from typing import Any, NamedTuple, Tuple

import numpy as np

TILE = 16  # pixels: the side of a tile
NEAR = 0.2  # world units: a Gaussian whose centre is not beyond it is not drawn
GUARD = 1.3  # times tan(fov / 2): where x/z and y/z are held when the projection is linearised
FARTHEST = 1 << 20  # pixels: a larger radius reaches every tile of any image anyway
SQUARE = 3.0  # standard deviations of a splat's longer axis: its radius, half the side of the square it is cut to
DILATION = 0.3  # pixels^2: added to the diagonal of the 2D covariance
# The three thresholds are float32 numbers there, and here in every type: in float64, 0.01 * 0.01 would not be below
# 1e-4, and a pixel behind two opaque Gaussians would not be finished.
MAX_ALPHA = float(np.float32(0.99))
MIN_ALPHA = float(np.float32(1 / 255))  # a fainter contribution is skipped
MIN_TRANSMITTANCE = float(np.float32(1e-4))  # a pixel is finished before its transmittance falls below

# The real spherical harmonics of degrees 0 to 3, in the order and with the signs that 3DGS stores them.
SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


class Pinhole(NamedTuple):
    """A camera as the rasterizer needs it, in plain numbers."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float  # COLMAP's: the image's left edge is 0, so the first pixel's centre is 0.5
    cy: float
    world_to_camera: np.ndarray  # [4, 4] float64
    position: np.ndarray  # [3] float64: the camera's centre in the world

    @property
    def tiles(self) -> Tuple[int, int]:
        """Return tiles across and down."""
        return -(-self.width // TILE), -(-self.height // TILE)

    @property
    def limits(self) -> Tuple[float, float]:
        """Return the limits at which |x/z| and |y/z| are held in the linearised projection."""
        return GUARD * self.width / (2 * self.fx), GUARD * self.height / (2 * self.fy)

    @classmethod
    def from_camera(cls, camera: Any) -> Pinhole:
        """Make one of anything with a pinhole camera's attributes (`legs_loss.scenes.Camera`)."""
        world_to_camera = np.ascontiguousarray(camera.world_to_camera, dtype=np.float64)
        rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
        position = -np.linalg.solve(rotation, translation)
        intrinsics = (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy))
        return cls(int(camera.width), int(camera.height), *intrinsics, world_to_camera, position)
