"""Gaussians to an image by the compiled rasterizer, which must agree with the readable oracle of the tests.

`rasterize` is the entry for 3DGS's own rasterizer; `draw` is the one for forks that change or return more. Modules that
need numba are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from legs_loss.lab.conventions import MIN_ALPHA as MIN_ALPHA
from legs_loss.lab.conventions import NEAR as NEAR
from legs_loss.lab.conventions import Pinhole as Pinhole
from legs_loss.lab.gaussians import Gaussians as Gaussians
from legs_loss.lab.gaussians import rotations as rotations
from legs_loss.lab.rasterizer.rasterize import Rendering as Rendering
from legs_loss.lab.rasterizer.rasterize import rasterize as rasterize

if TYPE_CHECKING:
    from legs_loss.lab.rasterizer.compact_box import CompactBox as CompactBox
    from legs_loss.lab.rasterizer.compiled import Tensors as Tensors
    from legs_loss.lab.rasterizer.compiled import said as said
    from legs_loss.lab.rasterizer.drawing import Contributions as Contributions
    from legs_loss.lab.rasterizer.drawing import Drawn as Drawn
    from legs_loss.lab.rasterizer.drawing import Lens as Lens
    from legs_loss.lab.rasterizer.drawing import compensation as compensation
    from legs_loss.lab.rasterizer.drawing import covariance as covariance
    from legs_loss.lab.rasterizer.drawing import draw as draw

_NAMES = {
    "compact_box": ["CompactBox"],
    "compiled": ["Tensors", "said"],
    "drawing": ["Contributions", "Drawn", "Lens", "compensation", "covariance", "draw"],
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
