"""What every stand-in's ``GaussianRasterizer`` is: a Module with a view's settings, and one error for what it lacks."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from legs_adapters.cpu.missing import MissingStandIn
from legs_loss.reference.conventions import NEAR

__all__ = ["Rasterizer"]


class Rasterizer(nn.Module):
    """Draws from the view of its settings; ``module`` is the import name of what it stands in for."""

    module: str

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def markVisible(self, positions: Tensor) -> Tensor:
        """Bool [N]: which of the points [N, 3] are beyond the near plane; upstream looks at nothing else."""
        view = self.raster_settings.viewmatrix
        with torch.no_grad():
            return positions @ view[:3, 2] + view[3, 2] > NEAR

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # torch asks
            return super().__getattr__(name)
        raise MissingStandIn(self.module, f"GaussianRasterizer.{name}")
