"""Gaussians to an image: the readable oracle, the compiled rasterizer that must agree with it, and their one entry."""

from legs_loss.reference.rasterizer.rasterize import Rendering, rasterize

__all__ = ["Rendering", "rasterize"]
