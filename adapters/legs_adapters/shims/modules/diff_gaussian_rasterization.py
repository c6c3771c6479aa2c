"""diff_gaussian_rasterization, the rasterizer of 3D Gaussian Splatting, on the CPU.

The interface is Inria's: settings as a named tuple, a Module that draws with them, the gradient of the image to the
splats' centres left in ``means2D.grad``. It draws with legs_loss's reference rasterizer. Forks use the same name for
rasterizers of their own: where the codebase expects another interface, it gets Taming 3DGS's, or an adapted one.
"""

from __future__ import annotations

import types
from typing import Any

from legs_adapters.shims.inria import forks, taming
from legs_adapters.shims.inria.rasterizer import Rasterizer
from legs_adapters.shims.inria.settings import SETTINGS, settings_type
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam", "module"]

GaussianRasterizationSettings: Any = settings_type(__name__)


class GaussianRasterizer(Rasterizer):
    """Draw Gaussians from the view of its settings; return image and radii."""


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``diff_gaussian_rasterization`` as this codebase expects it."""
    if interface.is_like(SETTINGS, 2):
        return complete(name, __doc__, GaussianRasterizationSettings, GaussianRasterizer, SparseGaussianAdam)
    return (taming if "pixel_weights" in interface.fields else forks).module(name, interface)
