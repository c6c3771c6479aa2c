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
from typing import Any, Dict, Mapping, Optional, Sequence


def install(sources: Dict[str, bytes]) -> None:
    """Import these sources, by real path, in place of the files on disk.

    A process that is spawned (`torch.multiprocessing.spawn`, DataLoader workers) starts as a new Python, which imports
    the script again: it installs the same sources before.
    """
    finder = Finder(sources)
    sys.meta_path.insert(0, finder)
    spawn: Any = multiprocessing.spawn
    prepare = spawn.get_preparation_data
    spawn.get_preparation_data = lambda name: dict(prepare(name), legs_finder=finder)

    def import_main(path: str) -> None:  # as multiprocessing does, which reads the file
        if getattr(sys.modules["__main__"], "__file__", None) == path:
            return
        spawn.old_main_modules.append(sys.modules["__main__"])
        module = main_module("__mp_main__", path)
        exec(Loader("__mp_main__", path, sources).get_code("__mp_main__"), module.__dict__)
        sys.modules["__main__"] = sys.modules["__mp_main__"] = module

    spawn._fixup_main_from_path = import_main


class Loader(importlib.machinery.SourceFileLoader):
    """Load a file's rewritten source, ``data``, in place of the file; no bytecode cache is read or written.

    ``data`` is None for a file that was not rewritten: it is loaded as it is.
    """

    def __init__(self, name: str, path: str, sources: Mapping[str, bytes]) -> None:
        super().__init__(name, path)
        self.data: Optional[bytes] = sources.get(os.path.realpath(path))

    def get_data(self, path: str | os.PathLike[str]) -> bytes:
        """Return the source; other files as they are on disk."""
        if self.data is not None and os.fspath(path) == self.path:
            return self.data
        return super().get_data(os.fspath(path))

    def get_code(self, fullname: str) -> CodeType:
        """Compile the source, and let tracebacks quote it."""
        data = self.get_data(self.path)
        if self.data is not None:
            text = importlib.util.decode_source(data)
            # Without a time of last change, linecache does not look at the disk again.
            linecache.cache[self.path] = (len(text), None, text.splitlines(keepends=True), self.path)
            vars(builtins)["legs_loss"] = importlib.import_module("legs_loss")  # the name in the text has no import
        return self.source_to_code(data, self.path)


class Finder:
    """Find modules as Python does, and replace the loader of rewritten ones.

    Unpickled it installs itself: in a spawned process, before that does anything else.
    """

    def __init__(self, sources: Dict[str, bytes]) -> None:
        self._sources = sources

    def __reduce__(self) -> Any:
        return install, (self._sources,)

    def find_spec(
        self, name: str, path: Optional[Sequence[str]] = None, target: Optional[types.ModuleType] = None
    ) -> Optional[importlib.machinery.ModuleSpec]:
        """Return the spec of a module that was rewritten; None for any other."""
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is None or not spec.origin or type(spec.loader) is not importlib.machinery.SourceFileLoader:
            return None
        spec.loader = loader = Loader(name, spec.origin, self._sources)
        return None if loader.data is None else spec


def main_module(name: str, script: str) -> types.ModuleType:
    """Return an empty module with the attributes that Python gives a script that it runs."""
    module = types.ModuleType(name)
    module.__loader__ = importlib.machinery.SourceFileLoader(name, script)
    module.__dict__.update(__file__=script, __builtins__=builtins, __cached__=None, __annotations__={})
    return module
