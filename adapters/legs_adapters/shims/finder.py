"""Find the shim of a CUDA module: the import hook that finds shims before Python finds the real modules.

A file in modules/ is the shim of the module that it is named after. It lists in ``__all__`` what scripts import from
that module; anything else is an error that names it. A module with submodules has ``module(name, interface)`` in place
of ``__all__``, which returns the module. With ``REAL_FIRST = True`` an installed real module is imported instead.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import pkgutil
import sys
import types
from typing import Any, Dict, NamedTuple, Optional, Sequence

from legs_adapters.shims import modules
from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["AMENDED", "Shim", "ShimFinder", "build", "install", "table_for"]

FORKS = "legs_adapters.shims.inria.forks"
# The real module is imported, then completed by `amend(module)` of this shim.
AMENDED: Dict[str, str] = {
    "torchmetrics.functional.image.lpips": "lpips",
    "torchmetrics.image.lpip": "lpips",
    "torchmetrics.image": "lpips",
}


class Shim(NamedTuple):
    """The module of this package that builds a shim, and the interface that the codebase expects."""

    home: str
    interface: Interface


def table_for(expected: Optional[Dict[str, Interface]] = None) -> Dict[str, Shim]:
    """Return the shims by import name, for a codebase whose rasterizers are expected to have these interfaces.

    A rasterizer without a file in modules/ is treated as a fork of Inria's.
    """
    table = {
        found.name: Shim(f"{modules.__name__}.{found.name}", Interface())
        for found in pkgutil.iter_modules(modules.__path__)
    }
    for name, interface in (expected or {}).items():
        home = table[name].home if name in table else FORKS
        table[name] = Shim(home, interface)
    return table


def build(name: str, shim: Shim) -> types.ModuleType:
    """Return the shim to be imported as ``name``."""
    home = importlib.import_module(shim.home)
    if hasattr(home, "module"):
        made: types.ModuleType = home.module(name, shim.interface)
        return made
    return complete(name, home.__doc__, *(getattr(home, part) for part in home.__all__))


class ShimFinder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Find the shims of a table, and their submodules."""

    def __init__(self, table: Dict[str, Shim]) -> None:
        self.table = table
        self._asking = False

    def find_spec(
        self, fullname: str, path: Optional[Sequence[str]] = None, target: Optional[types.ModuleType] = None
    ) -> Optional[importlib.machinery.ModuleSpec]:
        """Return the shim's spec, or None where the name is not in the table."""
        if self._asking:
            return None
        if fullname in AMENDED:
            return self._amended(fullname)
        if fullname in self.table:
            shim = self.table[fullname]
            real_first = getattr(importlib.import_module(shim.home), "REAL_FIRST", False)
            if real_first and (_is_for_a_library() or self._installed(fullname)):
                return None
            module = build(fullname, shim)
        else:
            parent, _, child = fullname.rpartition(".")
            if not self._made(parent):
                return None
            found = vars(sys.modules[parent]).get(child)
            # Any other submodule of a shim is missing by its whole name.
            module = found if isinstance(found, types.ModuleType) else complete(fullname, None)
        spec = importlib.machinery.ModuleSpec(fullname, self, is_package=True)
        spec.loader_state = module
        return spec

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> Any:
        """Return the module that was built."""
        return spec.loader_state

    def exec_module(self, module: types.ModuleType) -> None:
        """Do nothing: the module is complete."""

    def _made(self, name: str) -> bool:
        return getattr(getattr(sys.modules.get(name), "__spec__", None), "loader", None) is self

    def _installed(self, name: str) -> Optional[importlib.machinery.ModuleSpec]:
        self._asking = True
        try:
            return importlib.util.find_spec(name)
        except (ImportError, ValueError):
            return None
        finally:
            self._asking = False

    def _amended(self, name: str) -> Optional[importlib.machinery.ModuleSpec]:
        spec = self._installed(name)
        if spec is None or spec.loader is None:
            return None
        load = spec.loader.exec_module

        def exec_module(module: types.ModuleType) -> None:
            load(module)
            importlib.import_module(f"{modules.__name__}.{AMENDED[name]}").amend(module)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _is_for_a_library() -> bool:
    """Return whether an installed package does the import: it must not get a partial torchvision."""
    frame = sys._getframe(2)
    while frame is not None and "importlib" in frame.f_code.co_filename:
        frame = frame.f_back  # type: ignore[assignment]
    parts = frame.f_code.co_filename.replace("\\", "/").split("/") if frame is not None else []
    return "site-packages" in parts or "dist-packages" in parts


def install(table: Optional[Dict[str, Shim]] = None) -> ShimFinder:
    """Install the import hook before Python's own finders, and return it."""
    finder = ShimFinder(table_for() if table is None else table)
    sys.meta_path.insert(0, finder)
    return finder
