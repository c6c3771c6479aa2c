"""Replace attributes of torch reversibly; translate CUDA devices to the CPU."""

from __future__ import annotations

import functools
from typing import Any, Callable, List, Tuple

import torch

__all__ = ["Redirection", "constant", "on_cpu", "redirected"]


class Redirection:
    """The replaced attributes and their original values."""

    def __init__(self) -> None:
        self._replaced: List[Tuple[Any, str, Any, bool]] = []

    def replace(self, owner: Any, name: str, new: Any) -> None:
        """Set an attribute if it exists, and remember the old one."""
        if not hasattr(owner, name):
            return
        is_there = name in vars(owner)
        self._replaced.append((owner, name, vars(owner)[name] if is_there else None, is_there))
        setattr(owner, name, new)

    def wrap(self, owner: Any, name: str, make: Callable[[Any], Any]) -> None:
        """Replace an attribute by the result of ``make`` for it."""
        if hasattr(owner, name):
            old = getattr(owner, name)
            self.replace(owner, name, functools.update_wrapper(make(old), old, updated=()))

    def restore(self) -> None:
        """Restore all original values."""
        while self._replaced:
            owner, name, old, was_there = self._replaced.pop()
            if was_there:
                setattr(owner, name, old)
            else:
                delattr(owner, name)

    def __enter__(self) -> Redirection:
        return self

    def __exit__(self, *_: Any) -> None:
        self.restore()


def on_cpu(device: Any) -> Any:
    """Return the CPU for a CUDA device in any notation; anything else unchanged."""
    if isinstance(device, torch.device):
        return torch.device("cpu") if device.type == "cuda" else device
    if isinstance(device, str) and device.partition(":")[0] == "cuda":
        return "cpu"
    if isinstance(device, int) and not isinstance(device, bool):
        return "cpu"
    return device


def redirected(function: Any) -> Any:
    """Wrap a function so that its ``device=`` is the CPU and nothing is pinned."""

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        if "device" in kwargs:
            kwargs["device"] = on_cpu(kwargs["device"])
        if kwargs.get("pin_memory"):
            kwargs["pin_memory"] = False
        return function(*args, **kwargs)

    return wrapped


def constant(value: Any) -> Callable[..., Any]:
    """Return a function that returns ``value`` for any arguments."""
    return lambda *args, **kwargs: value
