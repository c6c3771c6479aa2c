"""The loss by the backend that is available for its images; each function returns None where torch has to do it."""

from __future__ import annotations

from typing import Callable, Optional

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import as_map, channels_first, is_compiling
from legs_loss.kernels.available import BACKENDS, OUT_OF_MEMORY, forced_backend
from legs_loss.kernels.contract import Backend, DeviceFault, NotNow, Weights
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_map

__all__ = ["fused_l1", "fused_loss", "fused_range", "fused_ssim"]


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weights: Weights,
    lambda_dssim: float,
    padding: str = "zeros",
    channels_last: bool = False,
) -> Optional[Tensor]:
    """Return what :func:`legs_loss.legs_loss` returns, by the backend for these images; None where that is torch.

    The arguments are checked as a pair already; maps and masks are in any shape that ``legs_loss`` takes.
    """
    unweighted = weights.map is weights.mask is None and (weights.spec is None or weights.spec.unweighted)
    if padding != "zeros" or lambda_dssim == 0.0 or (unweighted and not forced_backend()):
        return None  # unweighted it is 3DGS's own loss, to the last bit
    return _fused(
        "loss",
        prediction,
        target,
        weights,
        channels_last,
        lambda backend, first, second, resolved: backend.loss(first, second, resolved, lambda_dssim),
    )


def fused_l1(prediction: Tensor, target: Tensor, weights: Weights, channels_last: bool = False) -> Optional[Tensor]:
    """Return what :func:`legs_loss.weighted_l1` returns, by the backend for these images; None where that is torch."""
    return _fused(
        "l1",
        prediction,
        target,
        weights,
        channels_last,
        lambda backend, first, second, resolved: backend.weighted_l1(first, second, resolved),
    )


def fused_ssim(
    prediction: Tensor, target: Tensor, padding: str = "zeros", channels_last: bool = False
) -> Optional[Tensor]:
    """Return what :func:`legs_loss.ssim` returns, by the backend for these images; None where that is torch."""
    if padding != "zeros":
        return None
    return _fused(
        "ssim",
        prediction,
        target,
        Weights(),
        channels_last,
        lambda backend, first, second, _: backend.ssim(first, second),
    )


def fused_range(target: Tensor, spec: WeightSpec, channels_last: bool = False) -> Optional[Tensor]:
    """Return :meth:`~legs_loss.kernels.contract.Backend.response_range` of a target, [B, 2] (one image: [1, 2]).

    None where no backend makes the weights of this spec for this image by itself.
    """
    return _fused(
        "l1",
        target.detach(),
        target.detach(),
        Weights(spec),
        channels_last,
        lambda backend, _, second, resolved: (
            backend.response_range(second, spec) if resolved.spec is not None else None
        ),
        with_maps=False,
    )


Operation = Callable[[Backend, Tensor, Tensor, Weights], Optional[Tensor]]


def _fused(
    operation: str,
    prediction: Tensor,
    target: Tensor,
    weights: Weights,
    channels_last: bool,
    run: Operation,
    with_maps: bool = True,
) -> Optional[Tensor]:
    if is_compiling() or not _plain_tensors(prediction, target, weights.map, weights.mask, weights.range):
        return None
    backend = BACKENDS.ready(prediction.device)
    if backend is None or operation not in backend.offers:
        return None
    first, second = channels_first(prediction, channels_last), channels_first(target, channels_last)
    channels, height, width = first.shape[-3:]
    if channels > backend.most_channels or height * width > backend.most_pixels:
        return None
    if not {first.dtype, second.dtype} <= backend.dtypes:
        return None
    try:
        resolved = _resolved(backend, weights, target, channels_last, with_maps)
        return run(backend, first, second, resolved)
    except NotNow:
        return None
    except (LegsError, MemoryError, OUT_OF_MEMORY, DeviceFault):
        raise
    except Exception as error:  # a size or type that its trial did not cover
        BACKENDS.give_up(backend.name, prediction.device, error)
        return None


def _resolved(backend: Backend, weights: Weights, target: Tensor, channels_last: bool, with_maps: bool) -> Weights:
    """Return weights as the backend takes them: maps channels first, and no spec that it does not know."""
    spec, range_ = weights.spec, weights.range
    map_ = _map(weights.map, target, channels_last, "weight")
    if spec is not None and spec.unweighted:
        spec = None
    if spec is not None and not backend.makes_weights_of(spec):
        made = _map(weight_map(target, spec, channels_last), target, channels_last, "weight") if with_maps else None
        map_ = made if map_ is None or made is None else map_.to(made.dtype) * made
        spec = range_ = None
    return Weights(
        spec,
        range_,
        map_,
        _map(weights.mask, target, channels_last, "mask"),
        weights.renormalise,
    )


def _map(values: Optional[Tensor], target: Tensor, channels_last: bool, name: str) -> Optional[Tensor]:
    return None if values is None else channels_first(as_map(values, target, channels_last, name), channels_last)


def _plain_tensors(prediction: Tensor, *constants: Optional[Tensor]) -> bool:
    """Return whether the values are in plain memory, and only the prediction needs a gradient."""
    given = [tensor for tensor in constants if isinstance(tensor, Tensor)]
    return not any(tensor.requires_grad for tensor in given) and not any(map(_is_special, (prediction, *given)))


def _is_special(tensor: Tensor) -> bool:
    """Return whether this is a subclass of Tensor, or wrapped by torch.func."""
    if type(tensor) not in (Tensor, torch.nn.Parameter):
        return True
    functorch = getattr(torch._C, "_functorch", None)
    wrapped = getattr(functorch, "is_functorch_wrapped_tensor", None)
    return wrapped is not None and wrapped(tensor)
