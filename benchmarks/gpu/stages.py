"""The stages in the order in which they run: the function of each, and how many minutes it may take of 25.

Those that every run must have come first and fit together; each of the others is given up where their time is gone.
"""

from __future__ import annotations

import importlib
from typing import Any, Dict, NamedTuple

__all__ = ["CERTAIN", "STAGES", "Stage"]


class Stage(NamedTuple):
    """A stage: ``function`` of ``module`` in this folder, stopped after ``minutes`` of a run of 25."""

    module: str
    function: str
    minutes: float

    def load(self) -> Any:
        """Return the function, which takes the options and a callback that records results."""
        return getattr(importlib.import_module(f"benchmarks.gpu.{self.module}"), self.function)


# Together at most 24 minutes.
CERTAIN: Dict[str, Stage] = {
    "machine": Stage("machine", "machine", 1),
    "tests": Stage("tests", "tests", 4),
    "racecheck": Stage("tests", "racecheck", 2),
    "memcheck": Stage("tests", "memcheck", 2),
    "fused-ssim": Stage("building", "fused_ssim", 2),
    "times": Stage("times", "times", 3),
    "fastgs-build": Stage("building", "fastgs_modules", 4),
    "fastgs": Stage("training", "fastgs", 6),
}
STAGES: Dict[str, Stage] = {
    **CERTAIN,
    "synchronisation": Stage("behaviour", "synchronisation", 1),
    "graph": Stage("behaviour", "graph", 1),
    "stream": Stage("behaviour", "stream", 1),
    "compile": Stage("behaviour", "compile", 2),
    "gsplat": Stage("training", "gsplat", 10),
}
