"""legs-loss: the LEGS loss for 3D Gaussian Splatting.

    from legs_loss import l1_loss       # replaces the codebase's own

See README.md for the three entry points, docs/method.md for the mathematics.

A name is imported on first use, so that legs-patch does not import torch.
"""

import functools
import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, List

if TYPE_CHECKING:
    from legs_loss._version import __version__
    from legs_loss.curves import register_curve
    from legs_loss.errors import LegsError
    from legs_loss.loss import legs_loss, weighted_l1
    from legs_loss.operators import OPERATORS
    from legs_loss.response import response
    from legs_loss.runtime import configure, l1_loss, masked, unweighted
    from legs_loss.runtime.module import LEGSLoss
    from legs_loss.similarity import d_ssim
    from legs_loss.spec import PRESETS, WeightSpec
    from legs_loss.ssim import ssim
    from legs_loss.upstreams import apply_to
    from legs_loss.weights import weight_map

_HOMES = {
    "OPERATORS": "operators",
    "PRESETS": "spec",
    "LEGSLoss": "runtime.module",
    "LegsError": "errors",
    "WeightSpec": "spec",
    "__version__": "_version",
    "apply_to": "upstreams",
    "configure": "runtime",
    "d_ssim": "similarity",
    "l1_loss": "runtime",
    "masked": "runtime",
    "legs_loss": "loss",
    "register_curve": "curves",
    "response": "response",
    "ssim": "ssim",
    "unweighted": "runtime",
    "weight_map": "weights",
    "weighted_l1": "loss",
}

__all__ = [
    "OPERATORS",
    "PRESETS",
    "LEGSLoss",
    "LegsError",
    "WeightSpec",
    "__version__",
    "apply_to",
    "configure",
    "d_ssim",
    "l1_loss",
    "legs_loss",
    "masked",
    "register_curve",
    "response",
    "ssim",
    "unweighted",
    "weight_map",
    "weighted_l1",
]


class _Package(ModuleType):
    def __getattr__(self, name: str) -> object:
        if name.startswith("apply_to_"):  # legs_loss.apply_to_gsplat()
            library = name[len("apply_to_") :]
            if library in importlib.import_module("legs_loss.system").plugins("legs_loss.upstreams"):
                return functools.partial(importlib.import_module("legs_loss.upstreams").apply_to, library)
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        # Python binds imported submodules to their names here; the names ssim and response are the functions.
        if name not in _HOMES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)

    def __dir__(self) -> List[str]:
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _Package
