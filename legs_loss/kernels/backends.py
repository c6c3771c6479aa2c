"""Which code computes the loss: torch, or where they are installed and work, numba on the CPU and Triton on a GPU.

A backend is tried once before it is used, on a small image against torch. One that is not installed is passed over in
silence; one that fails, then or later, is named once on stderr; torch does the work then.
``LEGS_BACKEND=torch|numba|triton`` forces one; what that one does not take is torch's all the same.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import threading
from typing import Any, Callable, Dict, NamedTuple, Optional, Union

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import as_map, channels_first, is_compiling
from legs_loss.spec import WeightSpec
from legs_loss.ssim import d_ssim
from legs_loss.weights import weight_map

__all__ = ["BACKENDS", "Finding", "backend_for", "finding", "fused_or_none", "runs_on"]

Fused = Callable[[Tensor, Tensor, Union[Tensor, WeightSpec, None], float], Tensor]

_MODULES = {"numba": "legs_loss.kernels.numba_loss", "triton": "legs_loss.kernels.triton_loss"}
BACKENDS = ("torch", *_MODULES)
_DTYPES = (torch.float32, torch.float16, torch.bfloat16)
_MOST_CHANNELS = 4
_OUT_OF_MEMORY = getattr(torch.cuda, "OutOfMemoryError", MemoryError)


class Finding(NamedTuple):
    """What trying a backend on a device gave: its function, or why there is none.

    Attributes:
        fused: (prediction, target, weight, lambda_dssim) -> loss, or None.
        installed: whether its package is there at all.
        reason: in words.
    """

    fused: Optional[Fused]
    installed: bool
    reason: str


_findings: Dict[str, Finding] = {}
_lock = threading.RLock()
_forked = False


def backend_for(device: torch.device) -> str:
    """Return which backend the loss uses for images on a device: "torch", "numba" or "triton".

    Raises:
        LegsError: LEGS_BACKEND is none of these.
    """
    forced = _forced()
    name = forced or {"cpu": "numba", "cuda": "triton"}.get(device.type, "torch")
    if name == "torch" or not runs_on(name, device):
        return "torch"
    return name if finding(name, device).fused is not None else "torch"


def finding(name: str, device: torch.device) -> Finding:
    """Return what the trial of a backend on a device gave; it is run once a process."""
    key = f"{name} {device.type}"
    if key not in _findings:
        with _lock:
            if key not in _findings:
                _record(name, device, _try(name, device))
    return _findings[key]


def _record(name: str, device: torch.device, found: Finding) -> None:
    _findings[f"{name} {device.type}"] = found
    if found.fused is None and (found.installed or _forced() == name):
        print(f"legs-loss: {name} is not used, torch is: {found.reason}", file=sys.stderr, flush=True)


def _in_words(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip() or 'no message'}".splitlines()[0]


def fused_or_none(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec],
    mask: Optional[Tensor],
    lambda_dssim: float,
    padding: str,
    renormalise: bool,
    channels_last: bool,
) -> Optional[Tensor]:
    """Return what :func:`legs_loss.legs_loss` returns, by the backend for these images; None where that is torch.

    Args:
        weight: a map, or the spec to compute it with. The others are as for ``legs_loss``, and checked.
    """
    unweighted = isinstance(weight, WeightSpec) and weight.unweighted
    if unweighted and not _forced():
        return None  # 3DGS's own loss, to the last bit
    if padding != "zeros" or lambda_dssim == 0.0 or is_compiling() or not _takes(prediction, target, weight, mask):
        return None
    if channels_first(prediction, channels_last).shape[-3] > _MOST_CHANNELS:
        return None
    name = backend_for(prediction.device)
    if name == "torch":
        return None
    first, second = channels_first(prediction, channels_last), channels_first(target, channels_last)
    factor: Union[Tensor, WeightSpec, None] = weight
    if unweighted and mask is None:
        factor = None
    elif mask is not None or not isinstance(weight, WeightSpec):
        # A mask is a factor of the weight.
        factor = _map(weight, target, channels_last)
        if mask is not None:
            mask = as_map(mask, prediction, channels_last, "mask").float()
            factor = factor * (mask / _covered(mask) if renormalise else mask)
        factor = channels_first(factor, channels_last)
    fused = finding(name, prediction.device).fused
    assert fused is not None
    try:
        return fused(first, second, factor, lambda_dssim)
    except (LegsError, MemoryError, _OUT_OF_MEMORY):
        raise
    except Exception as error:  # a size, type or number of channels that its trial did not compile
        _record(name, prediction.device, Finding(None, True, _in_words(error)))
        return None


def _map(weight: Union[Tensor, WeightSpec], target: Tensor, channels_last: bool) -> Tensor:
    made = weight_map(target, weight, channels_last) if isinstance(weight, WeightSpec) else weight
    return as_map(made, target, channels_last, "weight").float()


def _covered(mask: Tensor) -> Tensor:
    return mask.mean().clamp(min=torch.finfo(mask.dtype).tiny)


def _takes(*tensors: Any) -> bool:
    prediction, *constants = [tensor for tensor in tensors if isinstance(tensor, Tensor)]
    if any(tensor.requires_grad for tensor in constants) or any(map(_is_special, (prediction, *constants))):
        return False
    return all(tensor.dtype in _DTYPES for tensor in (prediction, constants[0]))


def _is_special(tensor: Tensor) -> bool:
    """Whether the values are not plainly in memory: a subclass, or what torch.func wraps."""
    if type(tensor) not in (Tensor, torch.nn.Parameter):
        return True
    functorch = getattr(torch._C, "_functorch", None)
    wrapped = getattr(functorch, "is_functorch_wrapped_tensor", None)
    return wrapped is not None and wrapped(tensor)


def _forced() -> Optional[str]:
    name = os.environ.get("LEGS_BACKEND", "")
    if name and name not in BACKENDS:
        raise LegsError(f"LEGS_BACKEND must be one of {', '.join(BACKENDS)}, got {name!r}")
    return name or None


def runs_on(name: str, device: torch.device) -> bool:
    """Return whether a backend is for a device: numba for the CPU, Triton for CUDA or, interpreted, for the CPU."""
    if name == "numba":
        return device.type == "cpu" and not _forked
    interpreted = os.environ.get("TRITON_INTERPRET", "0") == "1"
    return device.type == "cuda" or (device.type == "cpu" and interpreted)


def _try(name: str, device: torch.device) -> Finding:
    try:
        if importlib.util.find_spec(name) is None:
            return Finding(None, False, "it is not installed")
        if name == "numba" and sys.version_info < (3, 8):
            return Finding(None, False, "the last numba for Python 3.7 takes minutes to compile the weights")
        fused = importlib.import_module(_MODULES[name]).fused_loss
        threads = torch.get_num_threads()
        problem = _difference_from_torch(fused, device)
        torch.set_num_threads(threads)  # numba's first parallel loop sets OpenMP's number, which is torch's too
    except Exception as error:  # whatever a broken install, compiler or driver raises
        return Finding(None, True, _in_words(error))
    return Finding(None if problem else fused, True, problem or "its trial agreed with torch")


def _difference_from_torch(fused: Fused, device: torch.device) -> Optional[str]:
    """Run a backend on a small image with every kind of weight; say what is wrong with the result.

    Of two tiles each way, where tiles are small; against float64, since a GPU's convolutions in float32 may be tf32's.
    """
    rows, columns = torch.arange(50.0).reshape(1, 50, 1), torch.arange(60.0).reshape(1, 1, 60)
    channels = torch.arange(1.0, 4.0).reshape(3, 1, 1)
    target = (0.5 + 0.4 * torch.sin(channels * (0.3 * rows + 0.2 * columns))).to(device)
    spec = WeightSpec()
    weights = weight_map(target, spec)
    exact = target.double()
    for weight, expected_weight in ((None, torch.ones_like(weights)), (spec, weights), (weights, weights)):
        results = []
        for function, dtype in (
            (lambda image, weight=weight: fused(image, target, weight, 0.2), torch.float32),
            (
                lambda image, weight=expected_weight: (
                    0.8 * (weight * (image - exact).abs()).mean() + 0.2 * d_ssim(image, exact)
                ),
                torch.float64,
            ),
        ):
            image = (0.9 * target + 0.02).to(dtype).requires_grad_()
            with torch.enable_grad():
                loss = function(image)
                (gradient,) = torch.autograd.grad(loss, image)
            results.append((loss.detach().double(), gradient.double()))
        (loss, gradient), (expected, reference) = results
        apart = float((gradient - reference).norm() / reference.norm())
        if not (abs(float(loss - expected)) <= 1e-4 * float(expected) and apart <= 1e-3):
            return f"its trial gave {float(loss):g} where torch gives {float(expected):g}, the gradient {apart:.2g} off"
    return None


def _after_fork() -> None:
    global _forked
    _forked = True  # the threads of numba did not come along; using them would end the process


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
