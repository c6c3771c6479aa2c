"""Perceptual metrics, by the packages of the extra [metrics]: FLIP, GMSD, HaarPSI; and LPIPS.

Each is computed where its package is installed, and left out elsewhere. Nothing is downloaded: LPIPS counts as
installed where the weights of its VGG lie in torch's own cache.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from functools import lru_cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

__all__ = ["NEEDS_LPIPS", "flip", "gmsd", "haarpsi", "has_flip", "has_lpips", "has_piq", "lpips"]

VGG = "vgg16-397923af.pth"  # as torchvision names its file
NEEDS_LPIPS = f"pip install lpips torchvision, and {VGG} in torch's cache of checkpoints: nothing is downloaded here"


@lru_cache(maxsize=None)
def has_flip() -> bool:
    """Return whether FLIP can be computed."""
    return importlib.util.find_spec("flip_evaluator") is not None


@lru_cache(maxsize=None)
def has_piq() -> bool:
    """Return whether GMSD and HaarPSI can be computed."""
    return importlib.util.find_spec("piq") is not None


@lru_cache(maxsize=None)
def has_lpips() -> bool:
    """Return whether LPIPS can be computed without a download."""
    from pathlib import Path

    installed = all(importlib.util.find_spec(name) is not None for name in ("lpips", "torchvision"))
    return installed and (Path(torch.hub.get_dir()) / "checkpoints" / VGG).is_file()


def flip(prediction: Tensor, target: Tensor) -> float:
    """Return the mean LDR-FLIP error of images [3, H, W] in [0, 1], at its 67 pixels a degree: 0 is the same.

    Source: Andersson et al. 2020, FLIP: a difference evaluator for alternating images; NVIDIA's flip-evaluator.
    """
    import flip_evaluator

    reference, test = (image.float().permute(1, 2, 0).contiguous().numpy() for image in (target, prediction))
    return float(flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False)[1])


def gmsd(prediction: Tensor, target: Tensor) -> float:
    """Return the gradient magnitude similarity deviation of images [3, H, W] in [0, 1]: 0 is the same.

    Source: Xue et al. 2014; by piq.
    """
    return float(_piq("gmsd").gmsd(prediction.float()[None], target.float()[None]))


def haarpsi(prediction: Tensor, target: Tensor) -> float:
    """Return the Haar wavelet similarity of images [3, H, W] in [0, 1], at least 16 pixels wide: 1 is the same.

    Source: Reisenhofer et al. 2018; by piq.
    """
    return float(_piq("haarpsi").haarpsi(prediction.float()[None], target.float()[None]))


def lpips(prediction: Tensor, target: Tensor) -> float:
    """Return LPIPS with VGG of images [3, H, W] in [0, 1]: 0 is the same. Source: Zhang et al. 2018."""
    with torch.no_grad():
        return float(_network()(prediction.float()[None], target.float()[None], normalize=True))


@lru_cache(maxsize=None)
def _network() -> Any:
    import lpips as package

    return package.LPIPS(net="vgg", verbose=False)


@lru_cache(maxsize=None)
def _piq(name: str) -> ModuleType:
    """Import one module of piq without the package's own imports: torchvision, for networks unused here.

    torchvision exists for few builds of torch, and raises RuntimeError with any other.
    """
    if "piq" not in sys.modules:
        found = importlib.util.find_spec("piq")
        assert found is not None and found.submodule_search_locations is not None
        package = ModuleType("piq")
        package.__path__ = list(found.submodule_search_locations)
        sys.modules["piq"] = package
        try:
            for module in ("gmsd", "haarpsi"):
                importlib.import_module(f"piq.{module}")
        finally:
            del sys.modules["piq"]  # who imports piq itself gets all of it
    return sys.modules[f"piq.{name}"]
