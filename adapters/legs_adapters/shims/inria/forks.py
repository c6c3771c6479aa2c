"""Build a rasterizer for an unknown fork: it returns the results that the fork's own code unpacks, by their names.

Unknown settings and inputs that change the image are an error, not ignored.
"""

from __future__ import annotations

import functools
import os
import re
import sys
import types
from typing import Any, Callable, Dict, Optional, Tuple

import torch
from torch import Tensor

from legs_adapters.shims.inria.rasterizer import Rasterizer
from legs_adapters.shims.inria.relocation import compute_relocation
from legs_adapters.shims.inria.settings import SETTINGS, settings_type
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import Absent, MissingShim, complete
from legs_loss.lab.rasterizer import Drawn, Lens

__all__ = ["kind_of", "module"]

# Settings without an effect here, or with one that is read from the names of the results.
HARMLESS = ("prefiltered", "debug", "f_count", "do_depth", "require_depth", "return_accumulation", "bwd_depth")
# Tensors without an effect where all of their values are this.
NEUTRAL = {"subpixel_offset": 0, "confidence": 1}
# The kinds of results, by name; the first match is used.
RESULTS: Tuple[Tuple[str, str], ...] = (
    (r"^_$", "unused"),
    (r"radi", "radii"),
    (r"^(pixels)$", "pixels"),
    (r"^(n_touched|gaussians?_count|countlist|accum_weights_count|num_gauss)$", "count"),
    (r"^(gs_w|important_score|accum_weights(_ptr)?|accum_blend|weights)$", "weight"),
    (r"^accum_max_count$", "most"),
    (r"^is_used$", "used"),
    (r"inv.*depth", "inverse depth"),
    (r"median|mode|loss|normal|coord|flow|feature|semantic|object|mask|time|uncert|infl", "unknown"),
    (r"depth", "depth"),
    (r"alpha|opac|^acc$|accumulation|silhouette", "alpha"),
    (r"image|colou?r|^im$|render|^rgb$", "image"),
)


def kind_of(name: str) -> str:
    """Return the kind of a result, by its name.

    >>> [kind_of(name) for name in ("rendered_image", "radii", "rendered_depth", "accum_alpha", "out_flow")]
    ['image', 'radii', 'depth', 'alpha', 'unknown']
    """
    return next((kind for pattern, kind in RESULTS if re.search(pattern, name.lower())), "unknown")


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return a rasterizer under this name, with the settings and results that ``interface`` asks for."""
    fields = SETTINGS + tuple(field for field in interface.fields if field not in SETTINGS)
    settings = settings_type(name, fields, optional=True)

    class GaussianRasterizer(Rasterizer):
        """Draw Gaussians from the view of its settings, and return the results that the caller unpacks."""

        module = name
        inputs = (*Rasterizer.inputs, "means2D_densify", "scores")

        def lens(self) -> Lens:
            return _lens(self.raster_settings, name)

        def results(self, drawn: Drawn, given: Dict[str, Any]) -> Any:
            if given["scores"] is not None and given["scores"].requires_grad:  # Speedy-Splat reads their gradient
                drawn.image = drawn.scored(given["scores"])
            names = _names_at_call(interface) or ("image", "radii")
            found = [_result(drawn, result, self.raster_settings, name) for result in names]
            return found[0] if len(found) == 1 else tuple(found)

    GaussianRasterizer.__module__ = name
    return complete(name, __doc__, settings, GaussianRasterizer, SparseGaussianAdam, compute_relocation)


_real_path = functools.lru_cache(maxsize=None)(os.path.realpath)


def _names_at_call(interface: Interface) -> Optional[Tuple[str, ...]]:
    frame = sys._getframe(2)
    while frame is not None:
        path = _real_path(frame.f_code.co_filename)
        if any(call.path == path for call in interface.calls):
            return interface.results_at(path, frame.f_lineno)
        frame = frame.f_back  # type: ignore[assignment]
    return None


def _lens(settings: Any, module: str) -> Lens:
    """Return how the fork's own settings change the footprints."""
    lens = Lens()
    for field in settings._fields[len(SETTINGS) :]:
        value = getattr(settings, field)
        if field in HARMLESS or value is None or value is False:
            continue
        if field == "antialiasing":
            lens = lens._replace(compensated=bool(value))
        elif field in ("kernel_size", "low_pass"):
            lens = lens._replace(dilation=float(value), compensated=lens.compensated or field == "kernel_size")
        elif field == "depth_threshold":
            lens = lens._replace(fade=float(value))
        elif not (field in NEUTRAL and isinstance(value, Tensor) and bool((value == NEUTRAL[field]).all())):
            raise MissingShim(module, f"GaussianRasterizationSettings({field}=...)")
    return lens


def _result(drawn: Drawn, name: str, settings: Any, module: str) -> Any:
    kind = kind_of(name)
    if kind == "depth" and "antialiasing" in settings._fields:
        kind = "inverse depth"  # Inria's own later rasterizer, whose depth is that
    makers: Dict[str, Callable[[], Any]] = {
        "image": lambda: drawn.image,
        "radii": lambda: drawn.radii,
        "depth": drawn.depth,
        "inverse depth": drawn.inverse_depth,
        "alpha": drawn.alpha,
        "used": lambda: drawn.radii > 0,
        "pixels": lambda: drawn.contributions().pixels[:, None].to(torch.float32),
        "count": lambda: drawn.contributions().pixels,
        "weight": lambda: drawn.contributions().blend,
        "most": lambda: drawn.contributions().most,
    }
    return makers[kind]() if kind in makers else Absent(module, name)
