"""Exclusive locks on files: one holder at a time, released by the system when the holder's process dies."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import stat
import sys
import time
from typing import Optional

from legs_loss.errors import LegsError
from legs_loss.system.files import PathLike

_POLL = 0.02  # seconds
_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EBADF)  # EBADF: another user's, on NFS
_FAR = 1 << 30  # the byte that Windows locks, and no other process can read: after all text


class HeldError(LegsError):
    """Another process holds the lock, and did not release it in time."""


class FileLock:
    """An exclusive lock on a file; a context manager.

    Where the file system has no locks, as that of some clusters, it is taken as free: `is_certain` is False then.

    Args:
        path: the file, made where it is missing, never through a link.
        wait: how many seconds to wait for another holder; None waits for ever.
        note: the holder, written to the file for waiting processes.
        remove: delete the file on release.

    Raises:
        HeldError: it is held; the message is the holder's note.
        OSError: the file cannot be made, or is a link (of either kind), a pipe or a folder.
    """

    def __init__(self, path: PathLike, wait: Optional[float] = None, note: str = "", remove: bool = False) -> None:
        self._path, self._remove = os.fspath(path), remove
        self.is_certain: bool = True
        until = math.inf if wait is None else time.monotonic() + wait
        while True:
            self._descriptor = _open(self._path)
            try:
                while not self._try():
                    if time.monotonic() >= until:
                        raise HeldError(os.read(self._descriptor, 500).decode("utf-8", "replace"))
                    time.sleep(_POLL)
                if remove and not _is_same(self._descriptor, self._path):  # its last holder has deleted it since
                    os.close(self._descriptor)
                    continue
                if note:
                    with contextlib.suppress(OSError):  # on a full disk the lock works without a note
                        os.ftruncate(self._descriptor, 0)
                        os.write(self._descriptor, note.encode("utf-8", "backslashreplace"))
                return
            except BaseException:
                os.close(self._descriptor)
                raise

    def release(self) -> None:
        """Release the lock."""
        if self._remove and os.name == "posix":  # elsewhere an open file cannot be deleted: an empty one stays
            with contextlib.suppress(PermissionError):  # another user's, in a folder like /tmp
                os.unlink(self._path)
        os.close(self._descriptor)

    def __enter__(self) -> FileLock:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _try(self) -> bool:
        try:
            return _try_lock(self._descriptor)
        except OSError as error:
            self.is_certain = error.errno not in _NO_LOCKS
            if self.is_certain:
                raise
            return True


def is_held(path: PathLike) -> bool:
    """Return whether another holds the lock of a file, or whether that cannot be found out."""
    try:
        with FileLock(path, wait=0.0) as lock:
            return not lock.is_certain
    except (OSError, HeldError):
        return True


def _open(path: str) -> int:
    if os.path.islink(path):  # for Windows; elsewhere the flag checks it without a race
        raise OSError(errno.ELOOP, "a link, which is not followed", path)
    flags = os.O_RDWR | os.O_CREAT
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY", "O_NOINHERIT"):
        flags |= getattr(os, name, 0)
    try:
        descriptor = os.open(path, flags, 0o666)
    except PermissionError:  # another user's, in a folder that both may write: to lock it, reading is enough
        if not os.path.lexists(path):
            raise
        descriptor = os.open(path, flags & ~(os.O_RDWR | os.O_CREAT))
    found = os.fstat(descriptor)
    if stat.S_ISREG(found.st_mode) and found.st_nlink <= 1:
        return descriptor
    os.close(descriptor)
    if found.st_nlink > 1:  # the note would overwrite that file
        raise OSError(errno.EMLINK, "a hard link to another file", path)
    raise OSError(errno.EINVAL, "not a regular file but a pipe, a socket or a device", path)


def _is_same(descriptor: int, path: str) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.lstat(path))
    except FileNotFoundError:
        return False


if sys.platform == "win32":
    import msvcrt

    def _try_lock(descriptor: int) -> bool:
        os.lseek(descriptor, _FAR, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        finally:
            os.lseek(descriptor, 0, os.SEEK_SET)
        return True
else:
    import fcntl

    def _try_lock(descriptor: int) -> bool:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True
