"""diff_gaussian_rasterization of Taming 3DGS: Inria's, with sums for scoring Gaussians.

With ``pixel_weights`` [H, W] in the settings, four more results hold sums over the pixels of each Gaussian; without,
they are empty. Upstream's per-pixel counts and lists, which its own code does not use, are missing.
"""

from __future__ import annotations

import types
from typing import Any, Dict, Tuple

import torch

from legs_adapters.shims.inria.rasterizer import GivenGaussians, Rasterizer
from legs_adapters.shims.inria.settings import SETTINGS, settings_type
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import Absent, complete
from legs_loss.lab.rasterizer import Drawn

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "module"]

GaussianRasterizationSettings: Any = settings_type(__name__, (*SETTINGS, "pixel_weights"))


class GaussianRasterizer(Rasterizer):
    """Draw Gaussians from the view of its settings."""

    module = "diff_gaussian_rasterization"
    inputs: Tuple[str, ...] = (*GivenGaussians._fields[:3], "dc", *GivenGaussians._fields[3:])

    def results(self, drawn: Drawn, given: Dict[str, Any]) -> Tuple[Any, ...]:
        """Return image, radii; counts, lists, listsRender, listsDistance; centres, depths, radii; and four sums.

        The sums, [N] each: of the pixels' weights, of pixels (int32), of transmittance times alpha, and of the
        distance from the centre in pixels.
        """
        weights = self.raster_settings.pixel_weights
        nothing, none = torch.empty(0), torch.empty(0, dtype=torch.int32)
        sums = (nothing, none, nothing, nothing)
        if weights is not None and weights.numel() > 1:
            found = drawn.contributions(weights)
            sums = (found.value, found.pixels, found.blend, found.distance)
        unused = (Absent(self.module, name) for name in ("counts", "lists", "listsRender", "listsDistance"))
        return (drawn.image, drawn.radii, *unused, *drawn.centres(), drawn.radii.clone(), *sums)


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization`` of Taming 3DGS."""
    return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
