"""LPIPS by weights that the user has: nothing is downloaded, nothing is unpickled, and torchvision is not needed."""

from __future__ import annotations

import importlib.util
from contextlib import suppress
from pathlib import Path
from typing import Any, Iterator, List, Mapping, NamedTuple, Optional, Sequence

import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from legs_loss.errors import LegsError

NEEDS_LPIPS = "--lpips WEIGHTS, a state dict of torchvision's squeezenet1_1, alexnet or vgg16"
_MAKE = ": give a state dict of torchvision's squeezenet1_1, alexnet or vgg16, as torch.save writes it"
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of images in [-1, 1]

_LEAST = 32  # pixels, which leave AlexNet one


class Network(NamedTuple):
    """A network's features, to the last that counts: how torchvision lays them out.

    Attributes:
        layers: c a convolution, r ReLU, p pooling, f a Fire module of SqueezeNet; of capitals the outcome counts.
        stride, padding: of the first convolution; the others keep the size.
        pool: pixels of the pooling's side; ``ceil``: whether a rest of an image is pooled, too.
    """

    layers: str
    stride: int
    padding: int
    pool: int
    ceil: bool = False


_NETWORKS = {
    "squeeze": Network("cRpfFpfFpFFFF", 2, 0, 3, True),
    "alex": Network("cRpcRpcRcRcR", 4, 2, 3),
    "vgg": Network("crcRpcrcRpcrcrcRpcrcrcRpcrcrcR", 1, 1, 2),
}


class PerceptualDistance(NamedTuple):
    """LPIPS by a network: its name, the weights of its features, and of the linear layers above those that count.

    Source: Zhang et al. 2018, version 0.1.
    """

    name: str
    state: Mapping[str, Tensor]
    linear: Sequence[Tensor]

    def features(self, x: Tensor) -> Iterator[Tensor]:
        """Yield the features [B, C, H, W] that count of images [B, 3, H, W] in [-1, 1]."""
        network = _NETWORKS[self.name]
        x = (x - x.new_tensor(_SHIFT)[:, None, None]) / x.new_tensor(_SCALE)[:, None, None]
        for at, layer in enumerate(network.layers):
            if layer == "c":
                x = self._convolved(x, str(at), *((network.stride, network.padding) if at == 0 else ()))
            elif layer == "p":
                x = max_pool2d(x, network.pool, 2, ceil_mode=network.ceil)
            elif layer in "rR":
                x = x.relu()
            else:
                x = self._convolved(x, f"{at}.squeeze").relu()
                x = torch.cat([self._convolved(x, f"{at}.expand{side}").relu() for side in ("1x1", "3x3")], 1)
            if layer.isupper():
                yield x

    def _convolved(self, x: Tensor, part: str, stride: int = 1, padding: Optional[int] = None) -> Tensor:
        weight, bias = (self.state[f"{part}.{what}"].to(x) for what in ("weight", "bias"))
        return conv2d(x, weight, bias, stride, weight.shape[-1] // 2 if padding is None else padding)

    def distance(self, prediction: Tensor, target: Tensor) -> Any:
        """Return LPIPS of images [3, H, W] in [0, 1], 0 for equal ones.

        It is of unit features, squared, weighted by channel, a mean over pixels, summed over what counts.
        """
        features = self.features(torch.stack([prediction, target]) * 2.0 - 1.0)
        units = [x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10) for x in features]
        return sum((w.to(x) * (x[0] - x[1]).square()).sum(0).mean() for x, w in zip(units, self.linear))


_used: Optional[PerceptualDistance] = None


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
        return float(_used.distance(prediction.float(), target.float()))


def _read(path: Path) -> PerceptualDistance:
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
    for name in _NETWORKS:
        with suppress(KeyError, AttributeError, RuntimeError, TypeError):  # what it has not, or of other shapes
            used = PerceptualDistance(name, found, _linear(name))
            used.distance(*torch.zeros(2, 3, 2 * _LEAST, 2 * _LEAST))
            return used
    raise LegsError(f"{path}: these are the weights of another network{_MAKE}")


def _linear(name: str) -> List[Tensor]:
    """Return LPIPS's linear layers of a network, each [C, 1, 1], from the package torchmetrics."""
    package = importlib.util.find_spec("torchmetrics")
    if package is None or not package.submodule_search_locations:
        raise LegsError("--lpips needs torchmetrics, which has LPIPS's linear layers: pip install torchmetrics")
    path = Path(package.submodule_search_locations[0], "functional", "image", "lpips_models", f"{name}.pth")
    layers = torch.load(str(path), map_location="cpu", weights_only=True)
    return [layers[key][0] for key in sorted(layers)]
