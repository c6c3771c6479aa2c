"""legs-loss: the LEGS loss for 3D Gaussian Splatting.

    from legs_loss import l1_loss       # replaces the codebase's own

See README.md for the three entry points, docs/method.md for the mathematics.

A name is imported on first use, so that legs-patch does not import torch.
"""

import functools
import importlib
from typing import TYPE_CHECKING, List

if TYPE_CHECKING:
    from legs_loss._version import __version__ as __version__
    from legs_loss.curves import register_curve as register_curve
    from legs_loss.errors import LegsError as LegsError
    from legs_loss.loss import legs_loss as legs_loss
    from legs_loss.loss import weighted_l1 as weighted_l1
    from legs_loss.operators import OPERATORS as OPERATORS
    from legs_loss.responses import response as response
    from legs_loss.runtime import configure as configure
    from legs_loss.runtime import l1_loss as l1_loss
    from legs_loss.runtime import unweighted as unweighted
    from legs_loss.runtime.terms import LEGSLoss as LEGSLoss
    from legs_loss.runtime.terms import coverage as coverage
    from legs_loss.runtime.terms import masked as masked
    from legs_loss.runtime.terms import ssim as ssim
    from legs_loss.similarity import d_ssim as d_ssim
    from legs_loss.spec import PRESETS as PRESETS
    from legs_loss.spec import WeightSpec as WeightSpec
    from legs_loss.upstreams import apply_to as apply_to
    from legs_loss.weights import weight_map as weight_map

# No module has the name of what it publishes: Python binds an imported module to its name here.
_NAMES = {
    "_version": ["__version__"],
    "curves": ["register_curve"],
    "errors": ["LegsError"],
    "loss": ["legs_loss", "weighted_l1"],
    "operators": ["OPERATORS"],
    "responses": ["response"],
    "runtime": ["configure", "l1_loss", "unweighted"],
    "runtime.terms": ["LEGSLoss", "coverage", "masked", "ssim"],
    "similarity": ["d_ssim"],
    "spec": ["PRESETS", "WeightSpec"],
    "upstreams": ["apply_to"],
    "weights": ["weight_map"],
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_HOMES]

importlib.import_module(f"{__name__}.counting")  # its last line is printed in every process that trains


def __getattr__(name: str) -> object:
    if name.startswith("apply_to_"):  # legs_loss.apply_to_gsplat()
        library = name[len("apply_to_") :]
        if library in importlib.import_module("legs_loss.system.entry_points").plugins("legs_loss.upstreams"):
            return functools.partial(importlib.import_module("legs_loss.upstreams").apply_to, library)
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    return value


def __dir__() -> List[str]:
    return sorted({*globals(), *__all__})
