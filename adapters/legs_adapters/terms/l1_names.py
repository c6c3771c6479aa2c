"""Names of L1 functions: torch's own, and what codebases call theirs."""

from __future__ import annotations

import re

__all__ = ["TORCH_L1", "is_l1_name"]

TORCH_L1 = re.compile(r"(^|\.)(torch\.nn\.functional|nn\.functional|functional)\.l1_loss$")
_L1_NAME = re.compile(
    r"^(masked|mask|weighted|pixel|pixelwise|rgb|color|image|photometric)*l1(loss)?(loss|mask(ed)?|rgb|withmask|v\d+)*$"
)


def is_l1_name(name: str) -> bool:
    """Return whether a function of this name is an L1, going by the name."""
    return _L1_NAME.match(name.replace("_", "").lower()) is not None
