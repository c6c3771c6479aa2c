"""Compiled kernels on disk: bytes under a key, each file with a checksum; damaged ones are compiled again."""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Mapping, Optional

__all__ = ["BinaryCache", "cache_folder"]

_DIGEST = hashlib.sha256().digest_size


def cache_folder(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> Optional[Path]:
    """Return the folder of compiled kernels: in XDG_CACHE_HOME, LOCALAPPDATA (Windows) or ~/.cache; None if none is."""
    if platform == "win32" and environment.get("LOCALAPPDATA"):
        return Path(environment["LOCALAPPDATA"]) / "legs-loss" / "kernels"
    base = environment.get("XDG_CACHE_HOME", "")
    try:
        return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "legs-loss" / "kernels"
    except RuntimeError:  # a container's user may have no home
        return None


class BinaryCache:
    """A folder of compiled kernels. Files that cannot be read or written are ignored.

    Args:
        folder: is made when something is kept; None keeps nothing.
    """

    def __init__(self, folder: Optional[Path]) -> None:
        self.folder = folder

    def get(self, key: bytes) -> Optional[bytes]:
        """Return what is kept under a key; None where there is nothing, or it is not what was written."""
        if self.folder is None:
            return None
        try:
            content = _path(self.folder, key).read_bytes()
        except OSError:
            return None
        digest, binary = content[:_DIGEST], content[_DIGEST:]
        return binary if binary and hashlib.sha256(key + binary).digest() == digest else None

    def put(self, key: bytes, binary: bytes) -> None:
        """Keep a binary: the file appears whole or not at all, whoever else writes it meanwhile."""
        if self.folder is None:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            handle, name = tempfile.mkstemp(dir=str(self.folder))
        except OSError:
            return
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(key + binary).digest() + binary)
            os.replace(name, str(_path(self.folder, key)))
        except OSError:
            with suppress(OSError):
                os.unlink(name)


def _path(folder: Path, key: bytes) -> Path:
    return folder / f"{hashlib.sha256(key).hexdigest()}.bin"
