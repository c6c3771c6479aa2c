"""Make tensors and modules on the CPU where a script names a CUDA device."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from legs_adapters.shims.torch_cuda.redirection import Redirection, on_cpu, redirected

__all__ = ["redirect"]

# torch.utils._device knows today's; before torch 2.0 there is no such list.
CONSTRUCTORS = """
    arange as_tensor asarray bartlett_window blackman_window empty empty_permuted empty_quantized empty_strided
    eye full hamming_window hann_window kaiser_window linspace logspace normal ones rand randint randn randperm
    range scalar_tensor sparse_bsc_tensor sparse_bsr_tensor sparse_compressed_tensor sparse_coo_tensor
    sparse_csc_tensor sparse_csr_tensor tensor tril_indices triu_indices zeros
"""


def redirect(redirection: Redirection) -> None:
    """Redirect constructors, methods and types of tensors, and moves of modules."""
    _tensors(redirection)
    _modules(redirection)
    _types(redirection)


def _tensors(redirection: Redirection) -> None:
    signal = getattr(torch, "signal", None)
    owners = [torch, torch.fft, getattr(torch, "nested", None), getattr(signal, "windows", None)]
    known, named = _known_constructors(), set(CONSTRUCTORS.split())
    for owner in filter(None, owners):
        for name, value in list(vars(owner).items()):
            is_constructor = value in known if _hashable(value) else False
            if is_constructor or (owner is torch and (name in named or name.endswith("_like"))):
                redirection.wrap(owner, name, redirected)
    for name in dir(Tensor):
        if name == "new" or name.startswith("new_"):
            redirection.wrap(Tensor, name, redirected)
    redirection.wrap(Tensor, "to", _to)
    redirection.wrap(Tensor, "cuda", lambda old: lambda self, *args, **kwargs: self)
    redirection.wrap(Tensor, "cpu", lambda old: lambda self, *args, **kwargs: _own_copy(old(self, *args, **kwargs)))
    redirection.wrap(Tensor, "pin_memory", lambda old: lambda self, *args, **kwargs: self)
    redirection.wrap(Tensor, "is_pinned", lambda old: lambda self, *args, **kwargs: False)
    redirection.wrap(Tensor, "record_stream", lambda old: lambda self, stream: None)
    redirection.wrap(Tensor, "type", _type)


def _known_constructors() -> Any:
    try:
        from torch.utils._device import _device_constructors
    except ImportError:
        return frozenset()
    return _device_constructors()


def _hashable(value: Any) -> bool:
    return callable(value) and getattr(value, "__hash__", None) is not None


def _own_copy(tensor: Tensor) -> Tensor:
    # A move from the GPU makes a copy: `kept = x.cpu()` does not change with x.
    return tensor.clone()


def _to(old: Any) -> Any:
    def to(self: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        target = kwargs.get("device", args[0] if args else None)
        if "device" in kwargs:
            kwargs["device"] = on_cpu(target)
        elif args and not isinstance(target, (torch.dtype, Tensor)):
            args = (on_cpu(target), *args[1:])
        result: Tensor = old(self, *args, **kwargs)
        # By name: `x.to(y.device)` stays where it is if y is on the GPU too, and says the same here.
        return _own_copy(result) if isinstance(target, str) and target == "cpu" and result is self else result

    return to


def _type(old: Any) -> Any:
    def type_of(self: Tensor, dtype: Any = None, *args: Any, **kwargs: Any) -> Any:
        return old(self, dtype, *args, **kwargs) if dtype is None else old(self, _cpu_type(dtype), *args, **kwargs)

    return type_of


def _cpu_type(kind: Any) -> Any:
    if isinstance(kind, str):
        return kind.replace("torch.cuda.", "torch.")
    return getattr(kind, "on_cpu", kind)


class _Legacy(type):
    """The type of ``torch.cuda.FloatTensor`` and the like: they create and match tensors of the CPU."""

    on_cpu: Any

    def __instancecheck__(cls, value: Any) -> bool:
        return isinstance(value, cls.on_cpu)

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        kwargs.pop("device", None)
        return cls.on_cpu(*args, **kwargs)


def _types(redirection: Redirection) -> None:
    for name in dir(torch.cuda):
        if name.endswith("Tensor") and hasattr(torch, name):
            kind = _Legacy(name, (), {"on_cpu": getattr(torch, name), "__module__": "torch.cuda"})
            redirection.replace(torch.cuda, name, kind)
    redirection.wrap(torch, "set_default_tensor_type", lambda old: lambda kind: old(_cpu_type(kind)))


def _modules(redirection: Redirection) -> None:
    module = torch.nn.Module
    redirection.wrap(module, "cuda", lambda old: lambda self, device=None: self)
    redirection.wrap(module, "to", _module_to)
    redirection.wrap(module, "cpu", lambda old: lambda self: self)
    # Scripts that were written to be compiled run as they are: the compiler would see the wrappers.
    redirection.wrap(torch.jit, "script", lambda old: _identity)
    redirection.wrap(torch.jit, "script_method", lambda old: lambda function, _rcb=None: function)


def _identity(obj: Any, *args: Any, **kwargs: Any) -> Any:
    return obj


def _module_to(old: Any) -> Any:
    def to(self: Any, *args: Any, **kwargs: Any) -> Any:
        args = tuple(on_cpu(value) if i == 0 else value for i, value in enumerate(args))
        if "device" in kwargs:
            kwargs["device"] = on_cpu(kwargs["device"])
        return old(self, *args, **kwargs)

    return to
