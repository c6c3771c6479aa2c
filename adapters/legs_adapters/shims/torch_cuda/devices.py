"""Load files, make generators and set default devices on the CPU."""

from __future__ import annotations

from typing import Any

import torch

from legs_adapters.shims.torch_cuda.loading import LoadsSafely
from legs_adapters.shims.torch_cuda.redirection import Redirection, on_cpu

__all__ = ["redirect"]


def redirect(redirection: Redirection) -> None:
    """Redirect torch.load, generators and default devices."""
    _loading(redirection)
    _devices(redirection)


def _loading(redirection: Redirection) -> None:
    both = LoadsSafely(torch.save, torch.load)
    redirection.wrap(torch, "save", lambda old: lambda *args, **kwargs: both.save(*args, **kwargs))
    redirection.wrap(torch, "load", lambda old: lambda *args, **kwargs: both.load(*args, **kwargs))


class _GeneratorType(type(torch.Generator)):  # type: ignore[misc]
    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, _Generator)


_Generator = torch.Generator


def _devices(redirection: Redirection) -> None:
    class Generator(_Generator, metaclass=_GeneratorType):
        """A random number generator, on the CPU."""

        def __new__(cls, device: Any = "cpu") -> Any:
            return _Generator.__new__(cls, on_cpu(device))  # type: ignore[call-arg]

        def __init__(self, device: Any = "cpu") -> None:
            pass

    redirection.replace(torch, "Generator", Generator)
    redirection.wrap(torch, "set_default_device", lambda old: lambda device: old(on_cpu(device)))
    try:
        from torch.utils._device import DeviceContext
    except ImportError:
        return
    redirection.wrap(DeviceContext, "__init__", lambda old: lambda self, device: old(self, on_cpu(device)))
