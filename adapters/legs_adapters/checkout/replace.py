"""Replacing files of a checkout: each atomically, all of them or none, nothing outside and nothing through a link."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import stat
import time
from pathlib import Path
from typing import Callable, Dict, Iterator, List, Optional, Tuple

from legs_adapters.code.folders import check_name
from legs_loss import LegsError
from legs_loss.system.ctrl_c import held_back
from legs_loss.system.files import open_regular, read_regular
from legs_loss.system.locks import FileLock, HeldError

# By relative path, in order: the bytes expected there now (None: no file), and the bytes to put there (None: remove).
Changes = Dict[str, Tuple[Optional[bytes], Optional[bytes]]]

MAX_FILE_BYTES = 8 << 20  # of a file that is read here: no source, no journal is larger
_LOCK, _STAGING = ".legs-patch.lock", ".legs-patch.tmp"
_ACCESS = "system.posix_acl_access"
_WAIT, _POLL = 30.0, 0.02  # seconds: a command holds the lock while it writes, and while git looks for changes
# Windows has no descriptors of folders: there paths are checked, then used.
_BY_DESCRIPTOR = {os.open, os.rename, os.unlink, os.stat} <= os.supports_dir_fd


@contextlib.contextmanager
def locked(root: Path, what: str) -> Iterator[Callable[[], None]]:
    """Hold the lock of a checkout; delete what a killed legs-patch left.

    Ctrl-C is held back until the lock is released: it leaves neither that nor the staging folder. Yield a function that
    raises KeyboardInterrupt where it was pressed, to be called wherever nothing is half done.

    Args:
        root: the checkout.
        what: the command of this process, for the error message of another one that waits.

    Raises:
        LegsError: another process holds the lock too long; or the folder cannot be written.
    """
    with held_back() as is_struck:

        def stop() -> None:
            if is_struck():
                raise KeyboardInterrupt

        with _lock(root, f"process {os.getpid()} ({what})", stop):
            _sweep(root)
            yield stop


def _lock(root: Path, note: str, stop: Callable[[], None]) -> FileLock:
    until = time.monotonic() + _WAIT
    while True:
        try:
            return FileLock(root / _LOCK, wait=_POLL, note=note, remove=True)
        except HeldError as error:
            if time.monotonic() > until:
                why = f"another legs-patch is running in {root}: {str(error) or 'it does not say which'}"
                raise LegsError(f"{why}; nothing was changed: wait for it") from None
        except OSError as error:
            raise LegsError(f"{error.filename or root}: {error.strerror}; nothing was changed") from None
        stop()


def replace_files(root: Path, changes: Changes, stop: Callable[[], None] = lambda: None) -> None:
    """Replace files, all of them or none. What somebody else saves meanwhile is not lost: it stops this, and stays.

    Args:
        root: the checkout.
        changes: the files. If they cannot be put back, the first one stays changed, too: the journal.
        stop: as :func:`locked` yields it; called while no file is replaced yet.

    Raises:
        LegsError: a file is not as expected, or cannot be written; no file is changed then, or the message says so.
    """
    staged: Dict[str, str] = {}
    done: List[str] = []
    try:
        for path, (expected, _) in changes.items():
            _check(path, read_file(root, path), expected)
        try:
            (root / _STAGING).mkdir(mode=0o700)
        except FileExistsError:  # what is one's own is swept
            why = "is what another user's killed legs-patch left: they can delete it"
            raise LegsError(f"{root / _STAGING} {why}") from None
        for path, (_, data) in changes.items():
            stop()
            if data is not None:
                staged[path] = _stage(root, path, data)
        for path, (before, _) in changes.items():
            _put(root, path, before, staged.get(path))
            done.append(path)
    except BaseException as error:
        _put_back(root, changes, done)
        if isinstance(error, OSError):
            raise LegsError(f"{error.filename or root}: {error.strerror}; nothing was changed") from None
        raise
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
        with _folder_of(root, path) as (folder, name):
            return read_regular(name, MAX_FILE_BYTES, folder)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LegsError(f"{full} cannot be read: {error.strerror}; nothing was changed") from None


@contextlib.contextmanager
def _folder_of(root: Path, path: str) -> Iterator[Tuple[Optional[int], str]]:
    """Open the folder of a file, part by part, none of them a link, even while somebody swaps one for a link.

    Yield its descriptor, and the file's name in it; where the system has no such descriptors, None and the whole path:
    functions of ``os`` take both as they take the first two. An OSError meanwhile names the whole path.
    """
    if not _BY_DESCRIPTOR:
        yield None, str(root / path)
        return
    *folders, name = path.split("/")
    options = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW
    folder: Optional[int] = None
    try:
        with contextlib.ExitStack() as opened:  # each is closed once, wherever Ctrl-C comes
            for part in (str(root), *folders):
                folder = os.open(part, options, dir_fd=folder)
                opened.callback(os.close, folder)
            yield folder, name
    except OSError as error:
        error.filename = str(root / path)
        raise


def _check(path: str, found: Optional[bytes], expected: Optional[bytes]) -> None:
    if found != expected:
        raise LegsError(f"{path} changed while legs-patch was running: nothing was written; run it again")


def _stage(root: Path, path: str, data: bytes) -> str:
    """Write what a file is to become to the staging folder, with owner, mode and attributes that the file has."""
    staged = f"{_STAGING}/{secrets.token_hex(8)}"
    with _folder_of(root, staged) as (folder, name):
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        with os.fdopen(os.open(name, flags, 0o666, dir_fd=folder), "wb") as file:
            file.write(data)
            file.flush()
            with contextlib.suppress(FileNotFoundError), _folder_of(root, path) as (target, old):
                with open_regular(old, target) as before:
                    found = os.fstat(before.fileno())
                    mode = _keep_owner(file.fileno(), found)
                    _keep_attributes(before.fileno(), file.fileno())
                # Last: giving a file away takes bits of its mode.
                os.chmod(file.fileno() if _BY_DESCRIPTOR else name, mode)
            os.fsync(file.fileno())
    return staged


def _keep_owner(file: int, before: os.stat_result) -> int:
    """Give an open file owner and group of another one, or the group alone; return the mode that it may have then."""
    for owner in (before.st_uid, -1):  # only root gives a file away, and only to one's own groups, on POSIX
        with contextlib.suppress(OSError, AttributeError):  # EINVAL: no owner or group of a user namespace
            os.fchown(file, owner, before.st_gid)
            break
    made, mode = os.fstat(file), stat.S_IMODE(before.st_mode)
    if made.st_gid != before.st_gid:  # another group may do what everybody may
        mode = mode & ~0o2070 | (mode & 7) << 3
    return mode if made.st_uid == before.st_uid else mode & ~0o4000


def _keep_attributes(before: int, after: int) -> None:
    """Give an open file the extended attributes of another one, access lists among them."""
    names: List[str] = []
    with contextlib.suppress(OSError, AttributeError):  # no such thing in this file system, or but on Linux
        names = os.listxattr(before)
        os.removexattr(after, _ACCESS)  # the staging folder may have given it one
    for name in names:
        try:
            os.setxattr(after, name, os.getxattr(before, name))
        except OSError:  # the system's own, as labels of SELinux, are not everybody's to set
            if name.startswith(("user.", _ACCESS)):
                raise


def _put(root: Path, path: str, expected: Optional[bytes], staged: Optional[str]) -> None:
    """Put a staged file in place of the one that is expected there; None removes that."""
    with _folder_of(root, path) as (folder, name):
        try:
            found = read_regular(name, MAX_FILE_BYTES, folder)
        except FileNotFoundError:
            found = None
        _check(path, found, expected)
        if staged is None:
            os.unlink(name, dir_fd=folder)
            return
        with _folder_of(root, staged) as (source, new):
            os.replace(new, name, src_dir_fd=source, dst_dir_fd=folder)


def _put_back(root: Path, changes: Changes, done: List[str]) -> None:
    """Put replaced files back, the last one first; a file that somebody else has saved since stays."""
    for path in reversed(done):
        before, after = changes[path]
        try:
            with contextlib.suppress(LegsError):
                _put(root, path, after, None if before is None else _stage(root, path, before))
        except OSError as error:
            raise LegsError(
                f"{error.filename or root}: {error.strerror}; some files are changed: legs-patch --undo {root}"
            ) from None


def _sweep(root: Path) -> None:
    """Delete the staging folder of this command or of one that was killed."""
    staging = root / _STAGING
    if staging.is_symlink():
        raise LegsError(f"{staging} is a link, and legs-patch does not follow links: delete it")
    shutil.rmtree(str(staging), ignore_errors=True)
