"""LPIPS, by its own package where that is installed, and its VGG's weights, too: nothing is downloaded."""

from __future__ import annotations

import importlib.util
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

__all__ = ["NEEDS_LPIPS", "has_lpips", "lpips"]

VGG = "vgg16-397923af.pth"  # as torchvision names its file
NEEDS_LPIPS = f"pip install lpips torchvision, and {VGG} in torch's cache of checkpoints: nothing is downloaded here"


@lru_cache(maxsize=None)
def has_lpips() -> bool:
    """Return whether LPIPS can be computed without a download."""
    installed = all(importlib.util.find_spec(name) is not None for name in ("lpips", "torchvision"))
    return installed and (Path(torch.hub.get_dir()) / "checkpoints" / VGG).is_file()


def lpips(prediction: Tensor, target: Tensor) -> float:
    """Return LPIPS with VGG of images [3, H, W] in [0, 1]: 0 is the same. Source: Zhang et al. 2018."""
    with torch.no_grad():
        return float(_network()(prediction.float()[None], target.float()[None], normalize=True))


@lru_cache(maxsize=None)
def _network() -> Any:
    import lpips as package

    return package.LPIPS(net="vgg", verbose=False)
