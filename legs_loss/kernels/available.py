"""Choose backends: one is available on a device where it is installed and gave torch's own results in a trial.

The trial of an operation runs once on a device for each operator, norm and curve, before their first use, on a small
image: what is not used is not compiled. A backend that is not installed is skipped silently; one that fails, then or
later, is reported once on stderr, and torch is used instead. ``LEGS_BACKEND=torch|numba|cuda`` forces one; images that
it does not support are computed by torch.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import threading
from contextlib import nullcontext
from functools import partial
from typing import Any, Callable, ContextManager, Dict, FrozenSet, NamedTuple, Optional, Tuple

import torch

from legs_loss.errors import LegsError
from legs_loss.kernels.contract import Backend, DeviceFault, NotNow
from legs_loss.spec import WeightSpec

OUT_OF_MEMORY = getattr(torch.cuda, "OutOfMemoryError", MemoryError)
_NAMES = ("torch", "numba", "cuda")
# An operation ("loss", "l1", "ssim"), and of the weights to be made operator, norm and curve (None: none are made).
_Case = Tuple[str, Optional[WeightSpec]]


class Availability(NamedTuple):
    """An answer: whether a device's backend is available.

    Attributes:
        backend: None where it is not.
        reason: why it is, or is not, available.
        tried: the cases whose trial it passed.
    """

    backend: Optional[Backend]
    reason: str
    tried: FrozenSet[_Case] = frozenset()


class Backends:
    """The backends of this process, and whether each device's is available.

    Attributes:
        known: by the type of a device, its backend's name and the module whose BACKEND it is.
        found: by the device, what was found.
    """

    def __init__(self) -> None:
        self.known: Dict[str, Tuple[str, str]] = {
            "cpu": ("numba", "legs_loss.kernels.numba_loss"),
            "cuda": ("cuda", "legs_loss.kernels.cuda.backend"),
        }
        self.found: Dict[torch.device, Availability] = {}
        # What LEGS_BACKEND says, raw. The environment's own memory is asked: os.environ takes three calls.
        environment: Any = os.environ
        memory = getattr(environment, "_data", environment)
        name = "LEGS_BACKEND" if memory is environment else environment.encodekey("LEGS_BACKEND")
        self.setting: Callable[[], Any] = partial(memory.get, name)
        self.after_fork()

    def chosen(self, device: torch.device, operation: str = "loss") -> str:
        """Return which backend computes an operation for images on a device: "torch" or the name of another.

        It is tried with the default spec.

        Raises:
            LegsError: LEGS_BACKEND is none of these.
        """
        name = self._wanted(device)
        return "torch" if name is None or self.availability(device, operation).backend is None else name

    def ready(self, device: torch.device, operation: str, spec: Optional[WeightSpec] = None) -> Optional[Backend]:
        """Return the backend of an operation on a device, None where that is torch: also where no trial may run now.

        Args:
            device: of the images.
            operation: as for :meth:`availability`.
            spec: of the weights that it is to make.
        """
        case = operation, None if spec is None else WeightSpec(spec.operator, spec.p, spec.curve)
        if self._wanted(device) is None or (is_capturing(device) and self._known_already(device, case) is None):
            return None  # a trial waits for the device, which would break a capture
        return self._answer(device, case).backend

    def _wanted(self, device: torch.device) -> Optional[str]:
        forced, (name, _) = forced_backend(), self.known.get(device.type, (None, ""))
        return name if forced in (None, name) else None

    def availability(self, device: torch.device, operation: str = "loss") -> Availability:
        """Return whether a device's backend is available for an operation ("loss", "l1", "ssim").

        A trial of the operation, with the default spec, runs once for each device. On a card that is full it is not
        available now, and the next call tries it again.

        Raises:
            DeviceFault: the device computes nothing any more, since a kernel has failed before.
        """
        return self._answer(device, (operation, WeightSpec()))

    def _answer(self, device: torch.device, case: _Case) -> Availability:
        with self._lock:
            return self._known_already(device, case) or self._tried(device, case)

    def _known_already(self, device: torch.device, case: _Case) -> Optional[Availability]:
        found = self.found.get(self.place(device))
        return found if found is None or found.backend is None or case in found.tried else None

    def give_up(self, device: torch.device, error: Exception) -> None:
        """Leave a backend that failed after its trial."""
        self._recorded(device, Availability(None, _in_words(error)))

    def place(self, device: torch.device) -> torch.device:
        """Return the device under which ``found`` has it: "cuda" alone is the current one."""
        if device.type == "cuda" and device.index is None and torch.cuda.is_available():
            return torch.device("cuda", torch.cuda.current_device())
        return device

    def after_fork(self) -> None:
        """Take a lock that no thread holds."""
        self._lock = threading.RLock()

    def _tried(self, device: torch.device, case: _Case) -> Availability:
        from legs_loss.kernels.trial import difference_from_torch

        name, module = self.known[device.type]
        missing = _why_missing(name)
        if missing:
            return self._recorded(device, Availability(None, missing), quiet=forced_backend() != name)
        try:
            backend = importlib.import_module(module).BACKEND
            # The first call may be in an evaluation, and the trial needs gradients; or in a checkpoint, which counts by
            # hooks what is saved, and would count what the trial saves.
            with torch.inference_mode(False), _own_hooks(), backend.preparing():
                problem = difference_from_torch(backend, device, *case)
        except (NotNow, MemoryError, OUT_OF_MEMORY) as error:  # it is tried again
            return Availability(None, _in_words(error))
        except DeviceFault:
            raise
        except Exception as error:  # anything that a broken install, compiler or driver raises
            if "CUDA error" in str(error):
                raise DeviceFault(str(error)) from error  # torch's own: it computes nothing on this device either
            problem = _in_words(error)
        if problem:
            return self._recorded(device, Availability(None, problem))
        before = self.found.get(self.place(device))
        tried = {case} if before is None else before.tried | {case}
        return self._recorded(device, Availability(backend, "its trial agreed with torch", frozenset(tried)))

    def _recorded(self, device: torch.device, found: Availability, quiet: bool = False) -> Availability:
        self.found[self.place(device)] = found
        if found.backend is None and not quiet:
            name, _ = self.known[device.type]
            print(f"legs-loss: {name} is unavailable, torch is used: {found.reason}", file=sys.stderr, flush=True)
        return found


BACKENDS = Backends()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=BACKENDS.after_fork)


def forced_backend() -> Optional[str]:
    """Return the backend that LEGS_BACKEND names, or None.

    Raises:
        LegsError: there is none of this name, or it is "cuda" where torch has no CUDA device.
    """
    name = os.environ.get("LEGS_BACKEND", "")
    if name and name not in _NAMES:
        raise LegsError(f"LEGS_BACKEND must be one of {', '.join(_NAMES)}, got {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        missing = _why_missing(name) or "there is no CUDA device here"
        raise LegsError(f"LEGS_BACKEND=cuda, but {missing}: unset LEGS_BACKEND")
    return name or None


def is_capturing(device: torch.device) -> bool:
    """Return whether launches on a device are being recorded into a CUDA graph."""
    probe = getattr(torch.cuda, "is_current_stream_capturing", None)
    return device.type == "cuda" and probe is not None and bool(probe())


def _why_missing(name: str) -> Optional[str]:
    """Return why a backend cannot be used in this installation."""
    if name == "cuda":
        return None if torch.version.cuda else "this torch is built without CUDA"
    return "it is not installed" if importlib.util.find_spec(name) is None else None


def _own_hooks() -> ContextManager[Any]:
    """Return what keeps hooks of tensors that autograd saves, of whoever is around, from those of a block."""
    allowed = getattr(torch._C._autograd, "_saved_tensors_hooks_is_enabled", None)
    if allowed is not None and not allowed():
        return nullcontext()
    return torch.autograd.graph.saved_tensors_hooks(lambda saved: saved, lambda saved: saved)


def _in_words(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).strip() or 'no message'}".splitlines()[0]
