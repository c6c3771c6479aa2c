"""Choose the code that computes the loss: torch, or a backend that is installed and works.

A backend is tested once before its first use, on a small image against torch. One that is not installed is skipped
silently; one that fails, then or later, is reported once on stderr, and torch is used instead.
``LEGS_BACKEND=torch|numba|cuda`` forces one; images that it does not support are computed by torch.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import threading
from typing import Callable, Dict, NamedTuple, Optional

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import as_map, channels_first, is_compiling
from legs_loss.kernels.contract import Backend, NotNow, Weights
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_map

__all__ = [
    "BACKENDS",
    "Finding",
    "backend_for",
    "finding",
    "fused_l1",
    "fused_loss",
    "fused_range",
    "fused_ssim",
    "is_capturing",
    "runs_on",
]

# A backend: the module whose BACKEND it is, and the type of the devices it is for.
_KNOWN = {
    "numba": ("legs_loss.kernels.numba_loss", "cpu"),
    "cuda": ("legs_loss.kernels.cuda.backend", "cuda"),
}
BACKENDS = ("torch", *_KNOWN)
_OUT_OF_MEMORY = getattr(torch.cuda, "OutOfMemoryError", MemoryError)


class Finding(NamedTuple):
    """The result of trying a backend on a device: the backend, or why it is not used.

    Attributes:
        backend: None where it is not used.
        installed: whether its package is installed.
        reason: why it is, or is not, used.
    """

    backend: Optional[Backend]
    installed: bool
    reason: str


_findings: Dict[str, Finding] = {}
_lock = threading.RLock()
_forked = False


def backend_for(device: torch.device) -> str:
    """Return which backend the loss uses for images on a device: "torch" or the name of another.

    Raises:
        LegsError: LEGS_BACKEND is none of these.
    """
    forced = _forced()
    name = forced or next((name for name in _KNOWN if runs_on(name, device)), "torch")
    if name == "torch" or not runs_on(name, device):
        return "torch"
    return name if finding(name, device).backend is not None else "torch"


def finding(name: str, device: torch.device) -> Finding:
    """Return the result of a backend's trial on a device, which runs once per process."""
    key = f"{name} {device.type}"
    if key not in _findings:
        with _lock:
            if key not in _findings:
                _record(name, device, _try(name, device))
    return _findings[key]


def runs_on(name: str, device: torch.device) -> bool:
    """Return whether a backend is for a device."""
    return device.type == _KNOWN[name][1] and not _forked


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
    if padding != "zeros" or lambda_dssim == 0.0 or (unweighted and not _forced()):
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
    backend = _ready_backend(prediction.device)
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
    except (LegsError, MemoryError, _OUT_OF_MEMORY):
        raise
    except Exception as error:  # a size or type that its trial did not cover
        _record(backend.name, prediction.device, Finding(None, True, _in_words(error)))
        return None


def _ready_backend(device: torch.device) -> Optional[Backend]:
    if is_capturing(device) and not _tried(device):
        return None  # a trial waits for the device, which would break a capture
    name = backend_for(device)
    return None if name == "torch" else finding(name, device).backend


def is_capturing(device: torch.device) -> bool:
    """Return whether launches on a device are being recorded into a CUDA graph."""
    probe = getattr(torch.cuda, "is_current_stream_capturing", None)
    return device.type == "cuda" and probe is not None and bool(probe())


def _tried(device: torch.device) -> bool:
    return all(f"{name} {device.type}" in _findings for name in _KNOWN if runs_on(name, device))


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


def _forced() -> Optional[str]:
    name = os.environ.get("LEGS_BACKEND", "")
    if name and name not in BACKENDS:
        raise LegsError(f"LEGS_BACKEND must be one of {', '.join(BACKENDS)}, got {name!r}")
    return name or None


def _try(name: str, device: torch.device) -> Finding:
    try:
        missing = _missing(name)
        if missing:
            return Finding(None, False, missing)
        from legs_loss.kernels.trial import difference_from_torch

        backend = importlib.import_module(_KNOWN[name][0]).BACKEND
        threads = torch.get_num_threads()
        with torch.inference_mode(False):  # the first call may be in an evaluation; the trial needs gradients
            problem = difference_from_torch(backend, device)
        torch.set_num_threads(threads)  # numba's first parallel loop sets OpenMP's number, which is torch's too
    except Exception as error:  # anything that a broken install, compiler or driver raises
        return Finding(None, True, _in_words(error))
    return Finding(None if problem else backend, True, problem or "its trial agreed with torch")


def _missing(name: str) -> Optional[str]:
    """Return why a backend cannot be used in this installation."""
    if name == "cuda":
        return None if torch.version.cuda else "this torch is built without CUDA"
    if importlib.util.find_spec(name) is None:
        return "it is not installed"
    if sys.version_info < (3, 8):
        return "the last numba for Python 3.7 takes minutes to compile the weights"
    return None


def _record(name: str, device: torch.device, found: Finding) -> None:
    _findings[f"{name} {device.type}"] = found
    if found.backend is None and (found.installed or _forced() == name):
        print(f"legs-loss: {name} is not used, torch is: {found.reason}", file=sys.stderr, flush=True)


def _in_words(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip() or 'no message'}".splitlines()[0]


def _after_fork() -> None:
    global _forked
    _forked = True  # numba's threads do not exist in a forked process; using them would crash it


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
