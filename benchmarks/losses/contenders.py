"""The contenders: LEGS by kernel and by torch, 3DGS's own loss, and other packages' SSIM, where they are installed."""

from __future__ import annotations

from typing import Any, Callable, Dict

import torch
from torch import Tensor

from legs_loss import legs_loss, weight_map
from legs_loss.kernels.available import BACKENDS
from legs_loss.kernels.contract import terms_of
from legs_loss.similarity import ssim_map
from legs_loss.spec import PRESETS

from .images import Pairs, in_turns

__all__ = ["LAMBDA", "LEGS", "Contenders", "losses", "reference_ssim", "weightings"]

LAMBDA = 0.2
LEGS = PRESETS["legs"]
Contenders = Dict[str, Callable[[], Any]]
Loss = Callable[[Tensor, Tensor, Tensor], Tensor]  # of prediction, target and the target's weight map


def losses(pairs: Pairs) -> Contenders:
    """Return each loss as a function that computes it and its gradient, each time of the next pair of images."""
    stored = [weight_map(target, LEGS) for _, target in pairs]
    device = pairs[0][0].device

    def l1(image: Tensor, target: Tensor) -> Tensor:
        return torch.abs(image - target).mean()

    def mixed(similarity: Callable[[Tensor, Tensor], Tensor]) -> Loss:
        return lambda image, target, _: (1.0 - LAMBDA) * l1(image, target) + LAMBDA * (1.0 - similarity(image, target))

    def batched(similarity: Callable[..., Tensor], *rest: Any, **settings: Any) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda image, target: similarity(image.unsqueeze(0), target.unsqueeze(0), *rest, **settings)

    contenders: Dict[str, Loss] = {}
    kernel = BACKENDS.ready(device, "loss")
    if kernel is not None:
        contenders["LEGS, weights in the kernel"] = lambda image, target, _: legs_loss(image, target, LEGS)
        contenders["LEGS, stored map"] = lambda image, target, stored: legs_loss(image, target, weight=stored)
        contenders["3DGS by the kernel"] = lambda image, target, _: kernel.loss(terms_of(LAMBDA), image, target)
    contenders["LEGS by torch"] = lambda image, target, _: (
        (1.0 - LAMBDA) * (weight_map(target, LEGS) * torch.abs(image - target)).mean()
        + LAMBDA * (1.0 - reference_ssim(image, target))
    )
    contenders["3DGS (torch)"] = mixed(reference_ssim)
    if device.type != "cuda":
        contenders["3DGS (torch, oneDNN off)"] = contenders["3DGS (torch)"]
    contenders["LEGS by torch.compile"] = torch.compile(contenders["LEGS by torch"])
    try:
        import kornia

        # kornia's value is (1 - SSIM) / 2
        half = batched(kornia.losses.ssim_loss, 11)
        contenders["kornia SSIM + L1"] = mixed(lambda image, target: 1.0 - 2.0 * half(image, target))
    except ImportError:
        pass
    try:
        import pytorch_msssim

        contenders["pytorch-msssim SSIM + L1"] = mixed(batched(pytorch_msssim.ssim, data_range=1.0))
    except ImportError:
        pass
    try:
        from torchmetrics.functional.image import structural_similarity_index_measure

        contenders["torchmetrics SSIM + L1"] = mixed(batched(structural_similarity_index_measure, data_range=1.0))
    except ImportError:
        pass
    try:
        from fused_ssim import fused_ssim

        if device.type == "cuda":
            alone = batched(fused_ssim)
            contenders["fused-ssim alone"] = lambda image, target, _: 1.0 - alone(image, target)
            contenders["fused-ssim + L1"] = mixed(alone)
    except ImportError:
        pass

    def switched(name: str, function: Loss) -> Callable[[Tensor, Tensor, int], Tensor]:
        def loss(image: Tensor, target: Tensor, i: int) -> Tensor:
            torch.backends.mkldnn.enabled = name != "3DGS (torch, oneDNN off)"  # type: ignore[assignment]
            return function(image, target, stored[i])

        return loss

    return {name: in_turns(pairs, switched(name, function)) for name, function in contenders.items()}


def reference_ssim(image: Tensor, target: Tensor) -> Tensor:
    """3DGS's own SSIM: torch's, whatever backend computes :func:`legs_loss.ssim`."""
    return ssim_map(image, target).mean()


def weightings(target: Tensor) -> Contenders:
    """Return each way to the weights of a photograph as a function."""
    found: Contenders = {"weight_map": lambda: weight_map(target, LEGS)}
    if not target.is_cuda and BACKENDS.availability(target.device).backend is not None:
        from legs_loss.kernels.numba_response import extremes, operator_of

        batch = target.unsqueeze(0).numpy()
        found["its extremes by numba (all the kernel keeps)"] = lambda: extremes(batch, operator_of(LEGS))
    try:
        import kornia

        def by_kornia() -> Tensor:
            values = kornia.filters.laplacian(target.unsqueeze(0), 3, border_type="reflect", normalized=False)
            strength = values.norm(dim=1, keepdim=True)
            low, high = strength.amin(), strength.amax()
            return 1.0 + LEGS.beta * torch.sqrt((strength - low) / (high - low + LEGS.eps))

        found["kornia.filters.laplacian + the same"] = by_kornia
    except ImportError:
        pass
    return found
