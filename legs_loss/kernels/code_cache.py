"""Machine code on disk for numba: one checked file for each function, signature and processor."""

from __future__ import annotations

import hashlib
import pickle
import re
import sys
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable, List, Optional

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps

from legs_loss.errors import LegsError
from legs_loss.system.files import write_whole
from legs_loss.system.terminal import is_first_process, say

_said: List[str] = []


def keep(function: Callable[..., Any], dispatcher: Any) -> None:
    """Have numba keep the machine code of a function on disk, where a folder can be written."""
    try:
        dispatcher._cache = _CodeCache(function)
    except RuntimeError:  # neither the package's folder nor the user's can be written
        _say("no folder can be written (the home's, or NUMBA_CACHE_DIR)")


class _CodeCache(FunctionCache):
    """The cache of a function, in the folder that numba finds for it.

    numba's own files have an index: a damaged one stops every later process, two processes that write one mix up its
    entries, and it does not see a change in a function of another file that is compiled into this one.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        base = re.sub(r"-\d+\.", ".", self._impl.filename_base)  # without the line
        files = _Files(Path(self.cache_path), base, _stamp(function.__module__))
        self._cache_file: Any = files

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # whatever unpickling raises: it is compiled anew, and written over
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except (OSError, LegsError) as error:
            _say(f"{error} (free that disk, delete that folder, or set NUMBA_CACHE_DIR)")


class _Files:
    """The files of a function, named by all that its code depends on, each with a checksum in front.

    Args:
        folder: where they are.
        base: with what their names begin.
        stamp: of the sources; what was made of others is removed when a file is written.
    """

    def __init__(self, folder: Path, base: str, stamp: str) -> None:
        self.folder, self.base, self.stamp = folder, base, stamp

    def _path(self, key: Any) -> Path:
        given = repr((key, [*map(_fields, key[0])]))  # the signature's own text has no names of fields
        return self.folder / f"{self.base}.{self.stamp}.{_digest(given.encode())}.nbc"

    def load(self, key: Any) -> Optional[Any]:
        try:
            content = self._path(key).read_bytes()
        except OSError:
            return None
        code = content[16:]
        return pickle.loads(code) if content[:16] == _digest(code).encode() else None

    def save(self, key: Any, data: Any) -> None:
        code = dumps(data)
        write_whole(self._path(key), _digest(code).encode() + code)
        for path in self.folder.iterdir():
            if path.name.startswith(f"{self.base}.") and f".{self.stamp}." not in path.name:
                with suppress(OSError):  # another process may have removed it
                    path.unlink()

    def flush(self) -> None:
        """Do nothing: numba asks for it where it recompiles, and a new file replaces the old one."""


@lru_cache(maxsize=None)
def _stamp(module: str) -> str:
    """Return a digest of numba's version and of all sources whose functions and numbers a module may compile in.

    These are its own, those of the modules that it imports names from, in its package or folder, and of theirs in turn.
    """
    texts, names, package = {}, [module], module.split(".")[0] + "."
    folder = Path(sys.modules[module].__file__ or "").parent
    for name in names:
        path = Path(getattr(sys.modules.get(name), "__file__", None) or "")
        if path.suffix == ".py" and name not in texts and (name.startswith(package) or path.parent == folder):
            texts[name] = path.read_bytes()
            names += (found.decode() for found in re.findall(rb"(?m)^from ([\w.]+) import", texts[name]))
    return _digest(b"\0".join([numba.__version__.encode(), *(texts[name] for name in sorted(texts))]))


def _fields(kind: Any) -> Any:
    return getattr(kind, "fields", ()), [*map(_fields, getattr(kind, "types", ()))]


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _say(why: str) -> None:
    if not _said:
        _said.append(why)
        if is_first_process():
            say(f"legs-loss: compiled code cannot be kept, so every run compiles anew: {why}", sys.stderr)
