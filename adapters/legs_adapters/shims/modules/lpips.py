"""lpips: the real metric where its networks are available; NaN and one warning where they are not.

The other metrics of an evaluation work then. Under the names ``lpipsPyTorch``, which forks carry with them, and
``lpips``, the package; and in the real ``torchmetrics``, which needs torchvision for it.
"""

from __future__ import annotations

import importlib
import sys
import types
from typing import Any, Callable, Optional, Type

import torch
from torch import Tensor, nn

from legs_adapters.shims import finder
from legs_adapters.shims.inria.survey import Interface

__all__ = ["amend", "module"]

_said = False


def _unavailable(error: BaseException) -> None:
    global _said
    if not _said:
        _said = True
        print(f"legs-loss: LPIPS is NaN: its networks are not available ({error})", file=sys.stderr, flush=True)


def _real(name: str) -> Any:
    """Import the real module, without the shim."""
    hook = next(found for found in sys.meta_path if isinstance(found, finder.ShimFinder))
    kept = {key: sys.modules.pop(key) for key in list(sys.modules) if key.split(".")[0] == name}
    entry = hook.table.pop(name)
    try:
        return importlib.import_module(name)
    finally:
        hook.table[name] = entry
        for key in [key for key in sys.modules if key.split(".")[0] == name]:
            del sys.modules[key]
        sys.modules.update(kept)


def _network(real: Callable[..., nn.Module]) -> Type[nn.Module]:
    """Return a class that builds the network by ``real``, or returns NaN."""

    class LPIPS(nn.Module):
        """The real network, or NaN."""

        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__()
            self.network: Optional[nn.Module] = None
            try:
                self.network = real(*args, **kwargs)
            except (KeyboardInterrupt, SystemExit):
                raise
            except BaseException as error:
                _unavailable(error)

        def forward(self, x: Tensor, y: Tensor, *args: Any, **kwargs: Any) -> Tensor:
            if self.network is not None:
                return self.network(x, y, *args, **kwargs)
            return torch.full((x.shape[0] if x.dim() == 4 else 1, 1, 1, 1), float("nan"))

    return LPIPS


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``lpipsPyTorch`` or ``lpips``."""
    made = types.ModuleType(name, __doc__)
    LPIPS = _network(lambda *args, **kwargs: _real(name).LPIPS(*args, **kwargs))
    criteria: Any = {}

    def lpips(x: Tensor, y: Tensor, net_type: str = "alex", version: str = "0.1") -> Tensor:
        """Return the distance of two images, or NaN."""
        if (net_type, version) not in criteria:
            criteria[net_type, version] = LPIPS(net_type, version)
        return criteria[net_type, version](x, y)

    made.LPIPS = LPIPS  # type: ignore[attr-defined]
    if name == "lpips":
        return made
    made.lpips = lpips  # type: ignore[attr-defined]
    modules, inner = types.ModuleType(f"{name}.modules"), types.ModuleType(f"{name}.modules.lpips")
    inner.LPIPS, modules.lpips, made.modules = LPIPS, inner, modules  # type: ignore[attr-defined]
    for part in (made, modules):
        part.__path__ = []
    return made


def amend(module: types.ModuleType) -> None:
    """Make a module of torchmetrics work without torchvision: its metric is the real one, its network may be NaN.

    Without torchvision, ``torchmetrics.image`` omits the metric, and the metric raises an error.
    """
    if module.__name__ == "torchmetrics.image":
        metric = importlib.import_module("torchmetrics.image.lpip").LearnedPerceptualImagePatchSimilarity
        module.LearnedPerceptualImagePatchSimilarity = metric  # type: ignore[attr-defined]
    elif module.__name__ == "torchmetrics.image.lpip":
        module._TORCHVISION_AVAILABLE = True  # type: ignore[attr-defined]
    else:
        module._NoTrainLpips = _network(module._NoTrainLpips)  # type: ignore[attr-defined]
