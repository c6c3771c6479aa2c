"""The trial of a backend: operations that it offers on a small image, value and gradient, against torch."""

from __future__ import annotations

from typing import Callable, Collection, Iterator, Optional, Tuple

import torch
from torch import Tensor

from legs_loss.kernels.contract import Backend
from legs_loss.similarity import d_ssim
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights, weight_map

__all__ = ["difference_from_torch"]

_SHARE = 0.2
_Loss = Callable[[Tensor], Tensor]


def difference_from_torch(
    backend: Backend, device: torch.device, operations: Collection[str], spec: Optional[WeightSpec] = None
) -> Optional[str]:
    """Run operations of a backend ("loss", "l1", "ssim") on a small image; describe the first wrong result.

    They run without weights, with a map, and with weights of a spec, if the backend makes these.

    The image has two tiles each way, where tiles are small. The reference is in float64, since a GPU's convolutions in
    float32 may be tf32's.
    """
    rows, columns = torch.arange(50.0).reshape(1, 50, 1), torch.arange(60.0).reshape(1, 1, 60)
    channels = torch.arange(1.0, 4.0).reshape(3, 1, 1)
    target = (0.5 + 0.4 * torch.sin(channels * (0.3 * rows + 0.2 * columns))).to(device)
    for name, function, reference in _operations(backend, target, operations, spec):
        results = []
        for loss_of, dtype in ((function, torch.float32), (reference, torch.float64)):
            image = (0.9 * target + 0.02).to(dtype).requires_grad_()
            with torch.enable_grad():
                loss = loss_of(image)
                (gradient,) = torch.autograd.grad(loss, image)
            results.append((loss.detach().double(), gradient.double()))
        (loss, gradient), (expected, exact) = results
        apart = float((gradient - exact).norm() / exact.norm())
        if not (abs(float(loss - expected)) <= 1e-4 * float(expected) and apart <= 1e-3):
            return (
                f"its trial of the {name} gave {float(loss):g} where torch gives {float(expected):g}, "
                f"the gradient {apart:.2g} off"
            )
    return None


def _operations(
    backend: Backend, target: Tensor, operations: Collection[str], spec: Optional[WeightSpec]
) -> Iterator[Tuple[str, _Loss, _Loss]]:
    """Yield of operations with each kind of weight: its name, the backend's function, and the reference."""
    exact = target.double()
    weights = weight_map(target, spec or WeightSpec())
    kinds = [(Weights(), torch.ones_like(weights)), (Weights(map=weights), weights)]
    if spec is not None and backend.makes_weights_of(spec):
        kinds.append((Weights(spec), weights))

    def l1(weight: Tensor) -> _Loss:
        return lambda image: (weight * (image - exact).abs()).mean()

    def whole(weight: Tensor) -> _Loss:
        return lambda image: (1.0 - _SHARE) * l1(weight)(image) + _SHARE * d_ssim(image, exact)

    def of_backend(operation: Callable[..., Tensor], *rest: object) -> _Loss:
        return lambda image: operation(image, target, *rest)

    for kind, weight in kinds:
        if "loss" in operations:
            yield "loss", of_backend(backend.loss, kind, _SHARE), whole(weight)
        if "l1" in operations:
            yield "weighted L1", of_backend(backend.weighted_l1, kind), l1(weight)
    if "ssim" in operations:
        yield "SSIM", of_backend(backend.ssim), lambda image: 1.0 - d_ssim(image, exact)
