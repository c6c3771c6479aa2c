"""Which module stands in for which: the table, and the import hook that puts them in.

A file of this package that is named in the table has ``module(name)``, which returns the stand-in for that import
name, complete with its submodules as attributes. One that is named in ``AMENDED`` has ``amend(module)``, which is given
the real module once it is loaded.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
import types
from typing import Any, Dict, NamedTuple, Optional, Sequence

from legs_adapters.cpu.missing import complete
from legs_adapters.cpu.survey import Interface

__all__ = ["AMENDED", "TABLE", "Finder", "StandIn", "build", "install", "table_for"]

INRIA = "diff_gaussian_rasterization"


class StandIn(NamedTuple):
    """Which file builds a module, whether a real one that is installed goes before it, and what the code expects."""

    file: str
    real_first: bool = False
    interface: Optional[Interface] = None


TABLE: Dict[str, StandIn] = {
    INRIA: StandIn("inria"),
    "diff_gaussian_rasterization_fastgs": StandIn("fastgs"),
    "diff_surfel_rasterization": StandIn("surfels"),
    "FasterGSCudaBackend": StandIn("fastergs"),
    "MortonEncoding": StandIn("fastergs"),
    "ppisp": StandIn("fastergs", real_first=True),
    "simple_knn": StandIn("simple_knn"),
    "fused_ssim": StandIn("fused_ssim"),
    "torchvision": StandIn("torchvision", real_first=True),
    "torch_scatter": StandIn("torch_scatter", real_first=True),
    "lpipsPyTorch": StandIn("lpips"),
    "lpips": StandIn("lpips"),
}
AMENDED: Dict[str, str] = {
    "torchmetrics.functional.image.lpips": "lpips",
    "torchmetrics.image.lpip": "lpips",
    "torchmetrics.image": "lpips",
}


def table_for(expected: Dict[str, Interface]) -> Dict[str, StandIn]:
    """Return the table for a codebase whose rasterizers are expected to have these interfaces.

    Inria's name is also that of many forks' own: it is Inria's rasterizer only where nothing more is expected of it.
    """
    table = dict(TABLE)
    for name, interface in expected.items():
        if name == INRIA and interface.is_like(inria_fields(), 2):
            continue
        if name == INRIA and "pixel_weights" in interface.fields:
            table[name] = StandIn("taming")
        elif name == INRIA or name not in table:
            table[name] = StandIn("generic", interface=interface)
    return table


def inria_fields() -> Sequence[str]:
    """Return the names of the settings of Inria's first rasterizer."""
    from legs_adapters.cpu.inria import GaussianRasterizationSettings

    return GaussianRasterizationSettings._fields


def build(name: str, entry: StandIn) -> types.ModuleType:
    """Return the stand-in for ``name``, made by its file of this package."""
    module = importlib.import_module(f"{__package__}.{entry.file}").module
    return module(name, entry.interface) if entry.interface is not None else module(name)


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the stand-ins of a table, and the submodules that hang on them, before Python looks for the real ones."""

    def __init__(self, table: Dict[str, StandIn]) -> None:
        self.table = table
        self._asking = False

    def find_spec(
        self, fullname: str, path: Optional[Sequence[str]] = None, target: Optional[types.ModuleType] = None
    ) -> Optional[importlib.machinery.ModuleSpec]:
        """Return the stand-in's spec, or None where the name is not in the table."""
        if self._asking:
            return None
        if fullname in AMENDED:
            return self._amended(fullname)
        if fullname in self.table:
            if self.table[fullname].real_first and (_is_for_a_library() or self._installed(fullname)):
                return None
            module = build(fullname, self.table[fullname])
        else:
            parent, _, child = fullname.rpartition(".")
            if not self._made(parent):
                return None
            found = vars(sys.modules[parent]).get(child)
            # Whatever else is imported from below a stand-in is missed by its whole name.
            module = found if isinstance(found, types.ModuleType) else complete(fullname, None)
        spec = importlib.machinery.ModuleSpec(fullname, self, is_package=True)
        spec.loader_state = module
        return spec

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> Any:
        """Return the module that was built."""
        return spec.loader_state

    def exec_module(self, module: types.ModuleType) -> None:
        """Nothing: it is complete."""

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
            importlib.import_module(f"{__package__}.{AMENDED[name]}").amend(module)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _is_for_a_library() -> bool:
    """Whether an installed package asks: one that does without torchvision should not take a part of it for all."""
    frame = sys._getframe(2)
    while frame is not None and "importlib" in frame.f_code.co_filename:
        frame = frame.f_back  # type: ignore[assignment]
    parts = frame.f_code.co_filename.replace("\\", "/").split("/") if frame is not None else []
    return "site-packages" in parts or "dist-packages" in parts


def install(table: Optional[Dict[str, StandIn]] = None) -> Finder:
    """Put the import hook in front of Python's own, and return it."""
    finder = Finder(dict(TABLE if table is None else table))
    sys.meta_path.insert(0, finder)
    return finder
