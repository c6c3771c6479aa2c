"""Seal a journal, to distinguish the user's own journals from those of others.

The seal is an HMAC under a key in the user's state folder (``$XDG_STATE_HOME/legs-loss``, by default
``~/.local/state/legs-loss``; on Windows ``%LOCALAPPDATA%\\legs-loss``). It is not bound to a path: a checkout can be
moved and then undone.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import tempfile
from pathlib import Path
from typing import Optional

from legs_loss.system import read_regular

__all__ = ["is_sealed", "seal"]

KEY = "journal.key"
_BYTES = 32


def seal(content: bytes, root: Path) -> Optional[str]:
    """Return the seal of a journal's content; None where no key can be read or made.

    Args:
        content: what is sealed.
        root: the checkout. A state folder inside of it is not used: others may have written it.
    """
    folder = _folder(root)
    key = None if folder is None else _read(folder) or _make(folder)
    return None if key is None else _seal(key, content)


def is_sealed(content: bytes, claimed: object, root: Path) -> bool:
    """Return whether a journal's seal was made by this user, with the key that is still there."""
    folder = _folder(root)
    key = None if folder is None else _read(folder)
    return key is not None and isinstance(claimed, str) and hmac.compare_digest(
        _seal(key, content).encode(), claimed.encode("utf-8", "replace")
    )  # fmt: skip


def _seal(key: bytes, content: bytes) -> str:
    return hmac.new(key, content, hashlib.sha256).hexdigest()


def _folder(root: Path) -> Optional[Path]:
    base = os.environ.get("XDG_STATE_HOME", "")
    if not os.path.isabs(base):
        base = os.environ.get("LOCALAPPDATA", "") if os.name == "nt" else os.path.expanduser("~/.local/state")
    if not os.path.isabs(base):
        return None
    folder = Path(os.path.realpath(os.path.join(base, "legs-loss")))
    return None if root == folder or root in folder.parents else folder


def _read(folder: Path) -> Optional[bytes]:
    try:
        key = read_regular(folder / KEY, 1 << 10)
    except OSError:
        return None
    return key if len(key) == _BYTES else None


def _make(folder: Path) -> Optional[bytes]:
    """Make the key; concurrent processes all get the first one's."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle, name = tempfile.mkstemp(dir=str(folder))
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(secrets.token_bytes(_BYTES))
                file.flush()
                os.fsync(file.fileno())
            _as_owner_of(folder.parent, folder, Path(name))
            with contextlib.suppress(FileExistsError):
                _publish(name, str(folder / KEY))
        finally:
            with contextlib.suppress(OSError):
                os.unlink(name)
    except OSError:
        return None
    return _read(folder)


def _publish(name: str, key: str) -> None:
    try:
        os.link(name, key)  # unlike a rename, never over a key that is there
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        if not os.path.exists(key):
            os.rename(name, key)


def _as_owner_of(parent: Path, *paths: Path) -> None:
    """Give files to the owner of a folder: under sudo, what root creates in a home folder must stay readable."""
    if getattr(os, "geteuid", lambda: -1)() == 0:
        owner = os.stat(str(parent))
        for path in paths:
            os.chown(str(path), owner.st_uid, owner.st_gid)
