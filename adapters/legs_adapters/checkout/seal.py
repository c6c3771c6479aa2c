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
from pathlib import Path
from typing import Optional

from legs_loss import LegsError
from legs_loss.system import FileLock, read_regular, write_whole

__all__ = ["is_sealed", "seal"]

KEY = "journal.key"
_BYTES = 32


def seal(content: bytes, root: Path, make: bool = True) -> Optional[str]:
    """Return the seal of a journal's content; None where no key can be read or made.

    Args:
        content: what is sealed.
        root: the checkout. A state folder inside of it is not used: others may have written it.
        make: whether a key is made where there is none.
    """
    folder = _folder()
    if folder is not None and root != folder and root not in folder.parents:
        with contextlib.suppress(OSError, LegsError):
            if make and not os.path.lexists(str(folder / KEY)):
                _make_key(folder)
            key = read_regular(folder / KEY, 1 << 10)
            if len(key) == _BYTES:
                return hmac.new(key, content, hashlib.sha256).hexdigest()
    return None


def is_sealed(content: bytes, claimed: object, root: Path) -> bool:
    """Return whether a journal's seal was made by this user, with the key that is still there."""
    own = seal(content, root, make=False)
    return own is not None and hmac.compare_digest(own.encode(), str(claimed).encode("utf-8", "replace"))


def _folder() -> Optional[Path]:
    base = os.environ.get("XDG_STATE_HOME", "")
    if not os.path.isabs(base):
        base = os.environ.get("LOCALAPPDATA", "") if os.name == "nt" else os.path.expanduser("~/.local/state")
    return Path(os.path.realpath(os.path.join(base, "legs-loss"))) if os.path.isabs(base) else None


def _make_key(folder: Path) -> None:
    """Make the key; concurrent processes all get the first one's."""
    key = folder / KEY
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with FileLock(folder / "journal.lock", wait=10.0, remove=True):
        if os.path.lexists(str(key)):
            return
        write_whole(key, secrets.token_bytes(_BYTES))
        os.chmod(str(key), 0o600)
