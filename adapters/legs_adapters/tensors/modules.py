"""List how torch and the libraries around it pass an ``nn.Module`` on: they move it, wrap it, return it."""

from __future__ import annotations

from legs_adapters.code.program import Conventions
from legs_adapters.tensors.operations import MODULE_SELF, MODULE_WRAPS

__all__ = ["TORCH"]

TORCH = Conventions(returning_self=MODULE_SELF, wrapping=MODULE_WRAPS)
