"""A complete small 3D Gaussian Splatting on the CPU, to develop and measure the loss.

from legs_loss.reference import Gaussians, rasterize
"""

from legs_loss.reference.gaussians import Gaussians
from legs_loss.reference.rasterizer import Rendering, rasterize

__all__ = ["Gaussians", "Rendering", "rasterize"]
