"""LPIPS by weights that the user has: nothing is downloaded, nothing is unpickled, and torchvision is not needed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import List, NamedTuple, Optional, Tuple

import torch
from torch import Tensor, nn

from legs_loss.errors import LegsError

__all__ = ["NEEDS_LPIPS", "has_lpips", "lpips", "network_name", "use_lpips"]

NEEDS_LPIPS = "--lpips WEIGHTS, a state dict of torchvision's squeezenet1_1, alexnet or vgg16"
_MAKE = ": give a state dict of torchvision's squeezenet1_1, alexnet or vgg16, as torch.save writes it"
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of images in [-1, 1]

_LEAST = 32  # pixels, which leave AlexNet one


class Network(NamedTuple):
    """A network's features as torchvision builds them, to the last that counts; ``taps``: those that count."""

    name: str
    features: nn.Sequential
    taps: Tuple[int, ...]


class Fire(nn.Module):
    """A module of SqueezeNet; its parts have torchvision's names."""

    def __init__(self, inputs: int, squeezed: int, each: int) -> None:
        super().__init__()
        self.squeeze: nn.Module = nn.Conv2d(inputs, squeezed, 1)
        self.expand1x1: nn.Module = nn.Conv2d(squeezed, each, 1)
        self.expand3x3: nn.Module = nn.Conv2d(squeezed, each, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return both expansions of the squeezed image."""
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def _squeeze() -> Network:
    def pool() -> nn.Module:
        return nn.MaxPool2d(3, 2, ceil_mode=True)

    fires = (Fire(64, 16, 64), Fire(128, 16, 64), pool(), Fire(128, 32, 128), Fire(256, 32, 128), pool())
    last = (Fire(256, 48, 192), Fire(384, 48, 192), Fire(384, 64, 256), Fire(512, 64, 256))
    features = nn.Sequential(nn.Conv2d(3, 64, 3, 2), nn.ReLU(), pool(), *fires, *last)
    return Network("squeeze", features, (1, 4, 7, 9, 10, 11, 12))


def _alex() -> Network:
    layers: List[nn.Module] = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    layers += [nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)]
    for inputs, outputs in ((192, 384), (384, 256), (256, 256)):
        layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
    return Network("alex", nn.Sequential(*layers), (1, 4, 7, 9, 11))


def _vgg() -> Network:
    layers: List[nn.Module] = []
    inputs = 3
    for outputs, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        layers += [nn.MaxPool2d(2, 2)] if layers else []
        for _ in range(count):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
    return Network("vgg", nn.Sequential(*layers), (3, 8, 15, 22, 29))


class LPIPS(nn.Module):
    """LPIPS of images [3, H, W] in [0, 1], 0 for equal ones. Source: Zhang et al. 2018, version 0.1."""

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.name: str = network.name
        self.features: nn.Sequential = network.features
        self.taps: Tuple[int, ...] = network.taps
        self.linear: List[Tensor] = _linear(network.name)

    def forward(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Return the distance: of unit features, squared, weighted by channel, a mean over pixels, summed over taps."""
        x = torch.stack([prediction, target]) * 2.0 - 1.0
        x = (x - x.new_tensor(_SHIFT)[:, None, None]) / x.new_tensor(_SCALE)[:, None, None]
        total = x.new_zeros(())
        weights = iter(self.linear)
        for at, layer in enumerate(self.features):
            x = layer(x)
            if at in self.taps:
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                total = total + (next(weights).to(x) * (unit[0] - unit[1]).square()).sum(0).mean()
        return total


_used: Optional[LPIPS] = None


def use_lpips(weights: Optional[Path]) -> None:
    """Score LPIPS from now on, by the network whose weights this file holds; None: no longer.

    Raises:
        LegsError: the file is not such a state dict, or torchmetrics, which has LPIPS's linear layers, is missing.
    """
    global _used
    _used = None if weights is None else _read(weights)


def has_lpips() -> bool:
    """Return whether :func:`use_lpips` gave a network."""
    return _used is not None


def network_name() -> str:
    """Return the name of the network in use: squeeze, alex or vgg."""
    assert _used is not None
    return _used.name


def lpips(prediction: Tensor, target: Tensor) -> float:
    """Return LPIPS of images [3, H, W] in [0, 1] by the network in use."""
    assert _used is not None
    if min(target.shape[1:]) < _LEAST:
        raise LegsError(f"LPIPS needs at least {_LEAST} pixels a side, got {tuple(target.shape[1:])}: omit --lpips")
    with torch.no_grad():
        return float(_used.to(prediction.device)(prediction.float(), target.float()))


def _read(path: Path) -> LPIPS:
    """Return LPIPS by the network of a state dict."""
    try:
        state = torch.load(str(path), map_location="cpu", weights_only=True)  # torch 1.12 refuses the last word
    except OSError as error:
        raise LegsError(f"cannot read {path}: {error.strerror or error}") from None
    except TypeError:
        raise LegsError(f"{path}: reading weights without unpickling them needs torch 1.13 or newer") from None
    except Exception:  # torch, pickle and zipfile raise nearly anything on a damaged file
        raise LegsError(f"{path}: this file holds more than tensors{_MAKE}") from None
    state = state if isinstance(state, dict) else {}
    found = {name[9:]: value for name, value in state.items() if str(name).startswith("features.")}
    for make in (_squeeze, _alex, _vgg):
        network = make()
        needed = network.features.state_dict()
        if all(getattr(found.get(name), "shape", None) == value.shape for name, value in needed.items()):
            network.features.load_state_dict({name: found[name] for name in needed})
            return LPIPS(network)
    raise LegsError(f"{path}: these are the weights of another network{_MAKE}")


def _linear(name: str) -> List[Tensor]:
    """Return LPIPS's linear layers of a network, each [C, 1, 1], from the package torchmetrics."""
    package = importlib.util.find_spec("torchmetrics")
    if package is None or not package.submodule_search_locations:
        raise LegsError("--lpips needs torchmetrics, which has LPIPS's linear layers: pip install torchmetrics")
    path = Path(package.submodule_search_locations[0], "functional", "image", "lpips_models", f"{name}.pth")
    layers = torch.load(str(path), map_location="cpu", weights_only=True)
    return [layers[key][0] for key in sorted(layers)]
