"""Replacing files of a checkout: each atomically, all of them or none, nothing outside and nothing through a link."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
from pathlib import Path
from typing import Dict, Iterator, List, Mapping, Optional, Tuple

from legs_adapters.code.folders import check_name
from legs_loss import LegsError
from legs_loss.system import FileLock, HeldError, held_back, read_regular

__all__ = ["LARGEST", "Changes", "locked", "read_file", "replace_files"]

# By relative path, in order: the bytes expected there now (None: no file), and the bytes to put there (None: remove).
Changes = Mapping[str, Tuple[Optional[bytes], Optional[bytes]]]

LARGEST = 64 << 20  # bytes of a file that is read here: no source, no journal is larger
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
    staging = root / _STAGING
    staged: Dict[str, str] = {}
    done: List[str] = []
    try:
        staging.mkdir(mode=0o700)
        for path, (_, data) in changes.items():
            if data is not None:
                staged[path] = _stage(staging, root / path, data)
        with held_back():
            try:
                for path, (_, data) in changes.items():
                    done.append(path)
                    if data is None:
                        (root / path).unlink()
                    else:
                        os.replace(staged[path], str(root / path))
            except BaseException:
                for path in reversed(done):
                    _restore(root, path, changes[path][0])
                raise
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
        return read_regular(full, LARGEST)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LegsError(f"{full} cannot be read: {error.strerror}; nothing was changed") from None


def _stage(staging: Path, target: Path, data: bytes) -> str:
    handle, name = tempfile.mkstemp(dir=str(staging))
    with os.fdopen(handle, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    try:
        before = os.stat(str(target))
    except FileNotFoundError:
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        return name
    if hasattr(os, "chown"):
        with contextlib.suppress(PermissionError):  # only root can give a file away
            os.chown(name, before.st_uid, before.st_gid)
    os.chmod(name, stat.S_IMODE(before.st_mode))  # last: giving a file away takes bits of its mode
    return name


def _restore(root: Path, path: str, data: Optional[bytes]) -> None:
    if read_file(root, path) == data:
        return
    if data is None:
        (root / path).unlink()
    else:
        os.replace(_stage(root / _STAGING, root / path, data), str(root / path))


def _sweep(root: Path) -> None:
    """Delete the staging folder of this command or of one that was killed."""
    staging = root / _STAGING
    if staging.is_symlink():
        raise LegsError(f"{staging} is a link, and legs-patch does not follow links: delete it")
    shutil.rmtree(str(staging), ignore_errors=True)
