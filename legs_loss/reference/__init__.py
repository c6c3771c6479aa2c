"""A complete small 3D Gaussian Splatting on the CPU: what the loss is developed against and measured with.

from legs_loss.reference import Gaussians, rasterize
"""

from legs_loss.reference.gaussians import Gaussians
from legs_loss.reference.rasterizer import Rendering, rasterize

__all__ = ["Gaussians", "Rendering", "rasterize"]
