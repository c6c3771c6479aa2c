"""Surfels (2D Gaussian Splatting) to an image: a compiled rasterizer."""

from legs_loss.lab.surfels.model import Surfels, SurfelView
from legs_loss.lab.surfels.rasterize import rasterize_surfels

__all__ = ["SurfelView", "Surfels", "rasterize_surfels"]
