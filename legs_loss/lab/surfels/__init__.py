"""Surfels (2D Gaussian Splatting) to an image: a compiled rasterizer."""

from legs_loss.lab.surfels.model import Surfels as Surfels
from legs_loss.lab.surfels.model import SurfelView as SurfelView
from legs_loss.lab.surfels.rasterize import rasterize_surfels as rasterize_surfels
