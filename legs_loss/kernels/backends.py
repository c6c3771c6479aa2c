"""The loss by the backend that is available for its images; each function returns None where torch has to do it."""

from __future__ import annotations

from typing import Any, Callable, Optional

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import is_compiling, is_transformed
from legs_loss.kernels.available import BACKENDS, OUT_OF_MEMORY, forced_backend
from legs_loss.kernels.contract import Backend, DeviceFault, NotNow
from legs_loss.spec import WeightSpec
from legs_loss.weights import Weights

__all__ = ["fused_l1", "fused_l1_of_target", "fused_loss", "fused_range", "fused_ssim"]


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weights: Weights,
    lambda_dssim: float,
    padding: str = "zeros",
) -> Optional[Tensor]:
    """Return what :func:`legs_loss.legs_loss` returns, by the backend for these images; None where that is torch.

    The arguments of this and the next functions are checked already, channels first, as the contract says.
    """
    unweighted = weights.map is None and (weights.spec is None or weights.spec.unweighted)
    if padding != "zeros" or lambda_dssim == 0.0 or (unweighted and not forced_backend()):
        return None  # unweighted it is 3DGS's own loss, bit-identical
    seen = weights.hidden(prediction, target)
    return _fused("loss", seen, target, weights, lambda backend, *given: backend.loss(*given, lambda_dssim))


def fused_l1(prediction: Tensor, target: Tensor, weights: Weights) -> Optional[Tensor]:
    """Return what :func:`legs_loss.weighted_l1` returns, by the backend for these images; None where that is torch."""
    return _fused("l1", prediction, target, weights, lambda backend, *given: backend.weighted_l1(*given))


def fused_l1_of_target(prediction: Tensor, target: Tensor, spec: WeightSpec) -> Optional[Tensor]:
    """Return :func:`fused_l1` with the weights of a spec, where a backend makes them in its own pass; else None."""

    def run(backend: Backend, first: Tensor, second: Tensor, resolved: Weights) -> Optional[Tensor]:
        return None if resolved.spec is None else backend.weighted_l1(first, second, resolved)

    return _fused("l1", prediction, target, Weights(spec), run, with_maps=False)


def fused_ssim(prediction: Tensor, target: Tensor, padding: str = "zeros") -> Optional[Tensor]:
    """Return what :func:`legs_loss.ssim` returns, by the backend for these images; None where that is torch."""
    if padding != "zeros":
        return None
    return _fused("ssim", prediction, target, Weights(), lambda backend, first, second, _: backend.ssim(first, second))


def fused_range(target: Tensor, spec: WeightSpec) -> Optional[Tensor]:
    """Return :meth:`~legs_loss.kernels.contract.Backend.response_range` of a target, [B, 2] (one image: [1, 2]).

    None where no backend makes the weights of this spec for this image by itself.
    """

    def run(backend: Backend, _: Tensor, second: Tensor, resolved: Weights) -> Optional[Tensor]:
        return None if resolved.spec is None else backend.response_range(second, spec)

    target = target.detach()
    return _fused("l1", target, target, Weights(spec), run, with_maps=False)


Operation = Callable[[Backend, Tensor, Tensor, Weights], Optional[Tensor]]


def _fused(
    operation: str,
    prediction: Tensor,
    target: Tensor,
    weights: Weights,
    run: Operation,
    with_maps: bool = True,
) -> Optional[Tensor]:
    if is_compiling() or is_transformed() or not _plain_tensors(prediction, target, weights.map, weights.range):
        return None
    backend = BACKENDS.ready(prediction.device, operation, weights.spec)
    if backend is None or operation not in backend.offers:
        return None
    channels, height, width = prediction.shape[-3:]
    if channels > backend.most_channels or height * width > backend.most_pixels:
        return None
    if not {prediction.dtype, target.dtype} <= backend.dtypes:
        return None
    try:
        loss = run(backend, prediction, target, _resolved(backend, weights, target, with_maps))
    except NotNow:
        return None
    except (LegsError, MemoryError, OUT_OF_MEMORY, DeviceFault):
        raise
    except Exception as error:  # a size or type that its trial did not cover
        BACKENDS.give_up(backend.name, prediction.device, error)
        return None
    return None if loss is None else weights.of_what_counts(loss)


def _resolved(backend: Backend, weights: Weights, target: Tensor, with_maps: bool) -> Weights:
    """Return weights as the backend takes them: without a spec that it does not know."""
    if weights.spec is None or (not weights.spec.unweighted and backend.makes_weights_of(weights.spec)):
        return weights
    return weights.with_map(target) if with_maps else weights._replace(spec=None, range=None)


def _plain_tensors(prediction: Tensor, *constants: Optional[Tensor]) -> bool:
    """Return whether the values are in plain memory, and only the prediction needs a gradient."""
    for tensor in (prediction, *constants):
        if tensor is None:
            continue
        if type(tensor) not in (Tensor, torch.nn.Parameter) or (tensor.requires_grad and tensor is not prediction):
            return False
        if _is_wrapped is not None and _is_wrapped(tensor):
            return False
    return prediction is not constants[0] or not prediction.requires_grad


_is_wrapped: Any = getattr(getattr(torch._C, "_functorch", None), "is_functorch_wrapped_tensor", None)  # by torch.func
