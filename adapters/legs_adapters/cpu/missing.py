"""The one error for what has no stand-in on the CPU, and modules that raise it for what they lack."""

from __future__ import annotations

import types
from typing import Any, Dict, List, Optional

from legs_loss import LegsError

__all__ = ["Absent", "Deferred", "MissingStandIn", "attribute_guard", "complete", "deferred_guard", "refuse_unknown"]


class MissingStandIn(LegsError, ImportError):
    """A CUDA feature that cannot be had on the CPU; the message names its module and function.

    It is an ImportError too, so that a script that only tries whether a module has something goes on without it.
    """

    def __init__(self, module: str, function: str, reason: str = "") -> None:
        what = f"{module}.{function}" if function else module
        super().__init__(f"{what} has no stand-in on the CPU" + (f": {reason}" if reason else ""))


def attribute_guard(module: str) -> Any:
    """Return a module's ``__getattr__``: what it lacks is a `MissingStandIn` that names it."""

    def __getattr__(name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        raise MissingStandIn(module, name)

    return __getattr__


def refuse_unknown(module: str, inputs: Dict[str, Any]) -> None:
    """Raise for the first input of a rasterizer's ``forward`` that is given and has no meaning here."""
    for name, value in inputs.items():
        if value is not None:
            raise MissingStandIn(module, f"GaussianRasterizer.forward({name}=...)")


def complete(name: str, doc: Optional[str], *parts: Any) -> types.ModuleType:
    """Return a module of these functions and classes, by their names; what else is asked of it is missing."""
    made = types.ModuleType(name, doc)
    for part in parts:
        setattr(made, part.__name__, part)
    made.__getattr__ = attribute_guard(name)  # type: ignore[method-assign]
    return made


def deferred_guard(module: str) -> Any:
    """As `attribute_guard`, for what scripts import more of than they use: the error comes with the use."""

    def __getattr__(name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        return Deferred(module, name)

    return __getattr__


class Deferred:
    """In the place of a function or class that has no stand-in: calling it, or asking for its parts, is the error."""

    def __init__(self, module: str, name: str) -> None:
        self.__dict__["_error"] = (module, name)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Raise the error."""
        raise MissingStandIn(*self.__dict__["_error"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        raise MissingStandIn(*self.__dict__["_error"])


class Absent:
    """In the place of a result that is not known here: any use of it is an error that names it."""

    def __init__(self, module: str, name: str) -> None:
        self.__dict__["_error"] = (module, f"GaussianRasterizer.forward's result {name!r}")

    def _refuse(self, *args: Any, **kwargs: Any) -> Any:
        raise MissingStandIn(*self.__dict__["_error"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name.endswith("__"):
            raise AttributeError(name)
        return self._refuse()

    __getitem__ = __iter__ = __len__ = __float__ = __add__ = __radd__ = __mul__ = __rmul__ = __sub__ = _refuse
    __rsub__ = __truediv__ = __rtruediv__ = __gt__ = __lt__ = __ge__ = __le__ = __invert__ = __neg__ = _refuse
    __torch_function__ = classmethod(lambda cls, *args, **kwargs: cls._refuse_any(args))

    @classmethod
    def _refuse_any(cls, args: Any) -> Any:
        for value in _flat(args):
            if isinstance(value, cls):
                value._refuse()


def _flat(values: Any) -> List[Any]:
    if isinstance(values, dict):
        return _flat(list(values.values()))
    if isinstance(values, (list, tuple)):
        return [inner for value in values for inner in _flat(value)]
    return [values]
