"""diff_gaussian_rasterization_fastgs: FastGS's rasterizer, with its compact box and its counts.

With Inria's settings: ``mult``, the size of the compact box; ``get_flag`` and ``metric_map`` [H * W], with which the
third result counts, for each Gaussian, the pixels marked 1 that it is blended into (empty without the flag). The
gradient of ``means2D`` has four columns: the last two are sums of absolute values.
"""

from __future__ import annotations

from typing import Any, Dict, Tuple

import torch
from torch import Tensor

from legs_adapters.shims.inria.rasterizer import GivenGaussians, Rasterizer
from legs_adapters.shims.inria.settings import SETTINGS, settings_type
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_loss.lab.rasterizer import CompactBox, Drawn, Lens

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]

EVERYWHERE = 1e6  # standard deviations: the square never clips a splat

GaussianRasterizationSettings: Any = settings_type(
    __name__, (*SETTINGS[:10], "mult", *SETTINGS[10:], "get_flag", "metric_map")
)


class GaussianRasterizer(Rasterizer):
    """Draw Gaussians from the view of its settings, each in the tiles of its compact box."""

    inputs: Tuple[str, ...] = (*GivenGaussians._fields[:3], "dc", *GivenGaussians._fields[3:])

    def lens(self) -> Lens:
        """Return a footprint that is not clipped to a square."""
        return Lens(square=EVERYWHERE)

    def clip(self, gaussians: GivenGaussians) -> CompactBox:
        """Return FastGS's compact box."""
        return CompactBox(gaussians.opacities, self.raster_settings.mult)

    def results(self, drawn: Drawn, given: Dict[str, Any]) -> Tuple[Tensor, ...]:
        """Return image [3, H, W], radii int32 [N], counts int32 [N]."""
        settings, counts = self.raster_settings, torch.empty(0, dtype=torch.int32)
        if settings.get_flag:
            marked = (settings.metric_map == 1).reshape(int(settings.image_height), int(settings.image_width))
            counts = drawn.contributions(marked).value.round().to(torch.int32)
        return drawn.image, drawn.radii, counts
