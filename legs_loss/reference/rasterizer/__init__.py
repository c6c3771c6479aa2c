"""Gaussians to an image: the readable oracle, the compiled rasterizer that must agree with it, and their one entry.

`rasterize` is the entry for 3DGS's own rasterizer; `draw` is the one for forks that change or return more. Modules that
need numba are imported on first use.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from legs_loss.reference.conventions import MIN_ALPHA, NEAR, View
from legs_loss.reference.rasterizer.rasterize import Rendering, rasterize

if TYPE_CHECKING:
    from legs_loss.reference.rasterizer.compact_box import CompactBox
    from legs_loss.reference.rasterizer.compiled import Tensors
    from legs_loss.reference.rasterizer.drawing import Contributions, Drawn, Lens, compensation, covariance, draw
    from legs_loss.reference.rasterizer.oracle import rotations

__all__ = [
    "MIN_ALPHA",
    "NEAR",
    "CompactBox",
    "Contributions",
    "Drawn",
    "Lens",
    "Rendering",
    "Tensors",
    "View",
    "compensation",
    "covariance",
    "draw",
    "rasterize",
    "rotations",
]

_HOMES = {
    "CompactBox": "compact_box",
    "Contributions": "drawing",
    "Drawn": "drawing",
    "Lens": "drawing",
    "Tensors": "compiled",
    "compensation": "drawing",
    "covariance": "drawing",
    "draw": "drawing",
    "rotations": "oracle",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
