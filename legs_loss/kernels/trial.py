"""The trial of a backend: losses of a small image, value and gradient, against torch."""

from __future__ import annotations

from functools import partial
from typing import Optional

import torch
from torch import Tensor

from legs_loss.kernels.contract import L1, SSIM, Backend, Terms, terms_of
from legs_loss.similarity import d_ssim
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights, weight_map

_TERMS = {"l1": L1, "ssim": SSIM, "loss": terms_of(0.2)}


def difference_from_torch(
    backend: Backend, device: torch.device, operation: str, spec: Optional[WeightSpec] = None
) -> Optional[str]:
    """Run a loss of a backend ("loss", "l1", "ssim") on a small image; describe the first wrong result.

    It runs without weights, with a map, and with weights of a spec, if the backend makes these.

    The image has two tiles each way, where tiles are small. The reference is in float64, since a GPU's convolutions in
    float32 may be tf32's.
    """
    rows, columns = torch.arange(50.0).reshape(1, 50, 1), torch.arange(60.0).reshape(1, 1, 60)
    channels = torch.arange(1.0, 4.0).reshape(3, 1, 1)
    target = (0.5 + 0.4 * torch.sin(channels * (0.3 * rows + 0.2 * columns))).to(device)
    exact = target.double()
    map_ = weight_map(target, spec or WeightSpec())
    kinds = [Weights(), Weights(map=map_)]
    if spec is not None and backend.makes_weights_of(spec):
        kinds.append(Weights(spec))
    terms = _TERMS[operation]
    for weights in kinds if terms.l1 else kinds[:1]:
        weight, results = torch.ones_like(map_) if weights is kinds[0] else map_, []
        ours = partial(backend.loss, terms, target=target, weights=weights)
        for loss_of, dtype in ((ours, torch.float32), (partial(_by_torch, terms, exact, weight), torch.float64)):
            image = (0.9 * target + 0.02).to(dtype).requires_grad_()
            with torch.enable_grad():
                loss = loss_of(image)
                (gradient,) = torch.autograd.grad(loss, image)
            results.append((loss.item(), gradient.double()))
        (found, gradient), (expected, right) = results
        apart = float((gradient - right).norm() / right.norm())
        if not (abs(found - expected) <= 1e-4 * expected and apart <= 1e-3):
            trial = f"its trial of the {operation} gave {found:g}"
            return f"{trial} where torch gives {expected:g}, the gradient {apart:.2g} off"
    return None


def _by_torch(terms: Terms, target: Tensor, weight: Tensor, image: Tensor) -> Tensor:
    similarity = 1.0 - d_ssim(image, target) if terms.ssim else 0.0
    return terms.l1 * (weight * (image - target).abs()).mean() + terms.ssim * similarity + terms.constant
