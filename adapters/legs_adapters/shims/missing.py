"""Raise one error for everything that has no shim on the CPU; build modules that raise it for missing names."""

from __future__ import annotations

import types
from typing import Any, Dict, List, Optional

import torch

from legs_loss import LegsError

__all__ = ["Absent", "Deferred", "MissingShim", "check_finite", "complete", "refuse_unknown"]


class MissingShim(LegsError, ImportError):
    """A CUDA feature without a shim; the message names its module and function.

    It is also an ImportError, so that a script that only tests for a feature continues without it.
    """

    def __init__(self, module: str, function: str, reason: str = "") -> None:
        what = f"{module}.{function}" if function else module
        super().__init__(f"{what} has no shim on the CPU" + (f": {reason}" if reason else ""))


def check_finite(owner: str, tensors: Dict[str, Any]) -> None:
    """Raise a LegsError for the first tensor that holds NaN or infinity; ``owner`` is the function that was called."""
    for name, tensor in tensors.items():
        if tensor is not None and not bool(torch.isfinite(tensor.detach().sum())):
            raise LegsError(f"{owner}: {name} {list(tensor.shape)} holds NaN or infinity")


def refuse_unknown(module: str, inputs: Dict[str, Any]) -> None:
    """Raise for the first input of a rasterizer's ``forward`` that is given and not supported."""
    for name, value in inputs.items():
        if value is not None:
            raise MissingShim(module, f"GaussianRasterizer.forward({name}=...)")


def complete(name: str, doc: Optional[str], *parts: Any, deferred: bool = False) -> types.ModuleType:
    """Return a module of these functions, classes and submodules, by their names.

    Any other name is a `MissingShim`: at once or, ``deferred``, on its first use, for modules of which scripts import
    more than they use.
    """
    made = types.ModuleType(name, doc)
    for part in parts:
        setattr(made, part.__name__.rpartition(".")[2], part)

    def __getattr__(missing: str) -> Any:
        if missing.startswith("__") and missing.endswith("__"):
            raise AttributeError(missing)
        if not deferred:
            raise MissingShim(name, missing)
        return Deferred(name, missing)

    made.__getattr__ = __getattr__  # type: ignore[method-assign]
    return made


class Deferred:
    """Replace a function or class that has no shim: a call, or a read of its attributes, is the error."""

    def __init__(self, module: str, name: str) -> None:
        self.__dict__["_error"] = (module, name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Raise the error."""
        raise MissingShim(*self.__dict__["_error"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        raise MissingShim(*self.__dict__["_error"])


class Absent:
    """Replace an unknown result of a rasterizer: any use of it is an error that names it."""

    def __init__(self, module: str, name: str) -> None:
        self.__dict__["_error"] = (module, f"GaussianRasterizer.forward's result {name!r}")

    def _refuse(self, *args: Any, **kwargs: Any) -> Any:
        raise MissingShim(*self.__dict__["_error"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        return self._refuse()

    @classmethod
    def __torch_function__(cls, *args: Any, **kwargs: Any) -> Any:
        for value in _flat(args):
            if isinstance(value, cls):
                value._refuse()


_USES = "getitem iter len float add radd mul rmul sub rsub truediv rtruediv gt lt ge le invert neg"
for _use in _USES.split():
    setattr(Absent, f"__{_use}__", Absent._refuse)


def _flat(values: Any) -> List[Any]:
    if isinstance(values, dict):
        return _flat(list(values.values()))
    if isinstance(values, (list, tuple)):
        return [inner for value in values for inner in _flat(value)]
    return [values]
