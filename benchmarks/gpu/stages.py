"""The stages in the order in which they run: the function of each, and how many minutes it may take of 25."""

from __future__ import annotations

import importlib
from typing import Any, Dict, NamedTuple

__all__ = ["STAGES", "Stage"]


class Stage(NamedTuple):
    """A stage: ``function`` of ``module`` in this folder, stopped after ``minutes`` of a run of 25."""

    module: str
    function: str
    minutes: float

    def load(self) -> Any:
        """Return the function, which takes the options and a callback that records results."""
        return getattr(importlib.import_module(f"benchmarks.gpu.{self.module}"), self.function)


STAGES: Dict[str, Stage] = {
    "machine": Stage("machine", "machine", 2),
    "tests": Stage("tests", "tests", 6),
    "fused-ssim": Stage("building", "fused_ssim", 4),
    "times": Stage("times", "times", 5),
    "synchronisation": Stage("behaviour", "synchronisation", 2),
    "graph": Stage("behaviour", "graph", 2),
    "stream": Stage("behaviour", "stream", 2),
    "compile": Stage("behaviour", "compile", 3),
    "fastgs-build": Stage("building", "fastgs_modules", 6),
    "fastgs": Stage("training", "fastgs", 10),
    "gsplat": Stage("training", "gsplat", 10),
}
