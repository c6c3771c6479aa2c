"""Import rewritten sources in place of files on disk: in this process, and in those that it spawns."""

from __future__ import annotations

import builtins
import importlib.machinery
import importlib.util
import linecache
import multiprocessing.spawn
import os
import sys
import types
from types import CodeType
from typing import Any, Dict, Optional, Sequence

__all__ = ["Finder", "Loader", "install", "main_module"]


def install(sources: Dict[str, bytes]) -> None:
    """Import these sources, by real path, in place of the files on disk.

    A process that is spawned (`torch.multiprocessing.spawn`, DataLoader workers) starts as a new Python, which imports
    the script again: it installs the same sources before.
    """
    sys.meta_path.insert(0, Finder(sources))
    spawn: Any = multiprocessing.spawn
    prepare = spawn.get_preparation_data

    def get_preparation_data(name: str) -> Dict[str, Any]:
        return dict(prepare(name), legs_sources=_Inherited(sources))

    spawn.get_preparation_data = get_preparation_data

    def import_main(path: str) -> None:  # as multiprocessing does, which reads the file
        if getattr(sys.modules["__main__"], "__file__", None) == path:
            return
        spawn.old_main_modules.append(sys.modules["__main__"])
        module = main_module("__mp_main__", path)
        exec(Loader("__mp_main__", path, sources.get(os.path.realpath(path))).get_code("__mp_main__"), module.__dict__)
        sys.modules["__main__"] = sys.modules["__mp_main__"] = module

    spawn._fixup_main_from_path = import_main


class _Inherited:
    """Sources that install themselves where they are unpickled: in a spawned process, before it does anything else."""

    def __init__(self, sources: Dict[str, bytes]) -> None:
        self._sources = sources

    def __reduce__(self) -> Any:
        return install, (self._sources,)


class Loader(importlib.machinery.SourceFileLoader):
    """Load a file's rewritten source in place of the file; no bytecode cache is read or written."""

    def __init__(self, name: str, path: str, data: Optional[bytes]) -> None:
        super().__init__(name, path)
        self._data = data

    def get_data(self, path: str | os.PathLike[str]) -> bytes:
        """Return the source; other files as they are on disk."""
        if self._data is not None and os.fspath(path) == self.path:
            return self._data
        return super().get_data(os.fspath(path))

    def get_code(self, fullname: str) -> CodeType:
        """Compile the source, and let tracebacks quote it."""
        data = self.get_data(self.path)
        if self._data is not None:
            text = importlib.util.decode_source(data)
            # Without a time of last change, linecache does not look at the disk again.
            linecache.cache[self.path] = (len(text), None, text.splitlines(keepends=True), self.path)
            vars(builtins)["legs_loss"] = importlib.import_module("legs_loss")  # the name in the text has no import
        return self.source_to_code(data, self.path)


class Finder:
    """Find modules as Python does, and replace the loader of rewritten ones."""

    def __init__(self, sources: Dict[str, bytes]) -> None:
        self._sources = sources

    def find_spec(
        self, name: str, path: Optional[Sequence[str]] = None, target: Optional[types.ModuleType] = None
    ) -> Optional[importlib.machinery.ModuleSpec]:
        """Return the spec of a module that was rewritten; None for any other."""
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is None or not spec.origin or type(spec.loader) is not importlib.machinery.SourceFileLoader:
            return None
        data = self._sources.get(os.path.realpath(spec.origin))
        if data is None:
            return None
        spec.loader = Loader(name, spec.origin, data)
        return spec


def main_module(name: str, script: str) -> types.ModuleType:
    """Return an empty module with the attributes that Python gives a script that it runs."""
    module = types.ModuleType(name)
    module.__dict__.update(
        __file__=script,
        __builtins__=sys.modules["builtins"],
        __cached__=None,
        __loader__=importlib.machinery.SourceFileLoader(name, script),
        __annotations__={},
    )
    return module
