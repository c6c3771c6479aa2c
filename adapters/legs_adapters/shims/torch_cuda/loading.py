"""Load checkpoints without unpickling files of unknown origin.

A bare ``torch.load`` reads tensors and plain values only. Anything else is unpickled, which can run any code, only for
files that this run wrote itself, or where the script or the user requests it explicitly.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import pickle
import weakref
from typing import Any, Callable, ContextManager, List, Set

import numpy as np
import torch

__all__ = ["LoadsSafely"]

ASKED_FOR = "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"  # torch's own switch, which it knows since 2.6


class LoadsSafely:
    """Replacements of ``torch.save`` and ``torch.load`` that record which files this run wrote.

    Args:
        save, load: torch's own.
    """

    def __init__(self, save: Callable[..., Any], load: Callable[..., Any]) -> None:
        self._save, self._load = save, load
        self._can_be_safe = "weights_only" in inspect.signature(load).parameters  # not before torch 1.13
        self._paths: Set[str] = set()
        self._buffers: Any = weakref.WeakSet()

    def save(self, obj: Any, f: Any, *args: Any, **kwargs: Any) -> Any:
        """Save as torch does, and record the file."""
        result = self._save(obj, f, *args, **kwargs)
        path = _path(f)
        if path is not None:
            self._paths.add(path)
        else:
            with contextlib.suppress(TypeError):  # the object takes no weak reference
                self._buffers.add(f)
        return result

    def load(self, f: Any, map_location: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Load to the CPU: tensors and plain values only, except from this run's own files or on request.

        Raises:
            pickle.UnpicklingError: another file holds more than that.
        """
        by_name = "weights_only" in kwargs or "pickle_module" in kwargs or bool(args)
        if by_name or not self._can_be_safe:
            return self._load(f, "cpu", *args, **kwargs)
        if os.environ.get(ASKED_FOR, "0").lower() in ("1", "y", "yes", "true"):
            return self._load(f, "cpu", weights_only=False, **kwargs)
        start = f.tell() if hasattr(f, "tell") else None
        try:
            with _plain_numbers():
                return self._load(f, "cpu", weights_only=True, **kwargs)
        except (pickle.UnpicklingError, RuntimeError) as error:
            if self._wrote(f):
                if start is not None:
                    f.seek(start)
                return self._load(f, "cpu", weights_only=False, **kwargs)
            if not isinstance(error, pickle.UnpicklingError):
                raise
            what = _path(f) or "this checkpoint"
            raise pickle.UnpicklingError(
                f"{what} holds more than tensors and plain values: reading it can run any code, and this run did not "
                f"write it. If you trust it, set {ASKED_FOR}=1, or write torch.load(..., weights_only=False)"
            ) from None

    def _wrote(self, f: Any) -> bool:
        path = _path(f)
        return path in self._paths if path is not None else f in self._buffers


def _path(f: Any) -> Any:
    """Return the real path of a file that is saved or loaded; None where it is not on disk."""
    name = f if isinstance(f, (str, os.PathLike)) else getattr(f, "name", None)
    return os.path.realpath(os.fspath(name)) if isinstance(name, (str, os.PathLike)) else None


def _plain_numbers() -> ContextManager[Any]:
    """Allow numpy's numbers: 3DGS's checkpoints hold the extent of the scene as one."""
    allow = getattr(torch.serialization, "safe_globals", None)  # torch 2.5
    if allow is None:
        return contextlib.ExitStack()
    core = getattr(np, "_core", None) or np.core
    kinds: List[Any] = [type(np.dtype(kind)) for kind in (np.float32, np.float64, np.int32, np.int64, np.bool_)]
    return allow([core.multiarray.scalar, np.dtype, *kinds])
