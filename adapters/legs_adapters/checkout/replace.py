"""Replacing files of a checkout: each atomically, all of them or none, nothing outside and nothing through a link."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
from pathlib import Path
from typing import Dict, Iterator, Optional, Tuple

from legs_adapters.checkout.inside import BY_DESCRIPTOR, folder_of
from legs_adapters.code.folders import check_name
from legs_loss import LegsError
from legs_loss.system import FileLock, HeldError, held_back, read_regular

__all__ = ["MAX_FILE_BYTES", "Changes", "locked", "read_file", "replace_files"]

# By relative path, in order: the bytes expected there now (None: no file), and the bytes to put there (None: remove).
Changes = Dict[str, Tuple[Optional[bytes], Optional[bytes]]]

MAX_FILE_BYTES = 8 << 20  # of a file that is read here: no source, no journal is larger
_LOCK, _STAGING = ".legs-patch.lock", ".legs-patch.tmp"
_WAIT = 30.0  # seconds: a command holds the lock while it writes, and while git looks for changes


@contextlib.contextmanager
def locked(root: Path, what: str) -> Iterator[None]:
    """Hold the lock of a checkout; delete what a killed legs-patch left.

    Args:
        root: the checkout.
        what: the command of this process, for the error message of another one that waits.

    Raises:
        LegsError: another process holds the lock too long; or the folder cannot be written.
    """
    note = f"process {os.getpid()} ({what})"
    try:
        lock = FileLock(root / _LOCK, wait=_WAIT, note=note, remove=True)
    except HeldError as error:
        who = f": {error}" if str(error) else ""
        raise LegsError(f"another legs-patch is running in {root}{who}; nothing was changed: wait for it") from None
    except OSError as error:
        raise LegsError(f"{error.filename or root}: {error.strerror}; nothing was changed") from None
    with lock:
        _sweep(root)
        yield


def replace_files(root: Path, changes: Changes) -> None:
    """Replace files, all of them or none; Ctrl-C is held back from the first one on.

    Raises:
        LegsError: a file is not as expected, or cannot be written; no file is changed then.
    """
    for path, (expected, _) in changes.items():
        if read_file(root, path) != expected:
            raise LegsError(f"{path} changed while legs-patch was running: nothing was written; run it again")
    staged: Dict[str, str] = {}
    try:
        (root / _STAGING).mkdir(mode=0o700)
        for path, (_, data) in changes.items():
            if data is not None:
                staged[path] = _stage(root, path, data)
        with held_back(), contextlib.ExitStack() as back:
            for path, (before, _) in changes.items():
                _put(root, path, staged.get(path))
                back.callback(_put_back, root, path, before)
            back.pop_all()
    except OSError as error:
        raise LegsError(f"{error.filename or root}: {error.strerror}; nothing was changed") from None
    finally:
        _sweep(root)


def read_file(root: Path, path: str) -> Optional[bytes]:
    """Return the bytes of a checkout's file; None where there is none.

    Raises:
        LegsError: the path is not one of a regular file in the checkout, reached through no link; or it cannot be read.
    """
    check_name(path)
    full = os.path.join(str(root), *path.split("/"))
    if os.path.normcase(os.path.realpath(full)) != os.path.normcase(full):
        raise LegsError(f"{path} is a link or below one: legs-patch does not follow links")
    try:
        with folder_of(root, path) as (folder, name):
            return read_regular(name, MAX_FILE_BYTES, folder)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LegsError(f"{full} cannot be read: {error.strerror}; nothing was changed") from None


def _stage(root: Path, path: str, data: bytes) -> str:
    """Write what a file is to become to the staging folder, with the owner and the mode that the file has."""
    staged = f"{_STAGING}/{secrets.token_hex(8)}"
    with folder_of(root, staged) as (folder, name):
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(name, flags, 0o666, dir_fd=folder), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
            with contextlib.suppress(FileNotFoundError), folder_of(root, path) as (target, old):
                before = os.stat(old, dir_fd=target, follow_symlinks=False)
                with contextlib.suppress(PermissionError, AttributeError):  # only root can give a file away, on POSIX
                    os.fchown(file.fileno(), before.st_uid, before.st_gid)
                # Last: giving a file away takes bits of its mode.
                os.chmod(file.fileno() if BY_DESCRIPTOR else name, stat.S_IMODE(before.st_mode))
    return staged


def _put(root: Path, path: str, staged: Optional[str]) -> None:
    """Put a staged file in its place; None removes the file that is there."""
    with folder_of(root, path) as (folder, name):
        if staged is None:
            os.unlink(name, dir_fd=folder)
            return
        with folder_of(root, staged) as (source, new):
            os.replace(new, name, src_dir_fd=source, dst_dir_fd=folder)


def _put_back(root: Path, path: str, before: Optional[bytes]) -> None:
    _put(root, path, None if before is None else _stage(root, path, before))


def _sweep(root: Path) -> None:
    """Delete the staging folder of this command or of one that was killed."""
    staging = root / _STAGING
    if staging.is_symlink():
        raise LegsError(f"{staging} is a link, and legs-patch does not follow links: delete it")
    shutil.rmtree(str(staging), ignore_errors=True)
