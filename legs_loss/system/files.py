"""Read files of any kind safely (pipes, devices, huge files), and write files atomically."""

from __future__ import annotations

import codecs
import contextlib
import errno
import functools
import os
import re
import secrets
import stat
import time
from typing import BinaryIO, Callable, List, Optional, Union

from legs_loss.errors import LegsError

PathLike = Union[str, "os.PathLike[str]"]
_ABANDONED = 3600.0  # seconds since the last byte


def open_regular(path: PathLike, folder: Optional[int] = None) -> BinaryIO:
    """Open a regular file for reading; never wait for a pipe's other end.

    Args:
        path: the file; with ``folder``, the descriptor of an open folder, its name in there, and no link.

    Raises:
        OSError: it cannot be opened, or is a folder, a pipe, a socket or a device; ``strerror`` says which.
    """
    name = os.fspath(path)
    try:
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        descriptor = os.open(name, flags if folder is None else flags | os.O_NOFOLLOW, dir_fd=folder)
    except ValueError:  # a NUL in the name
        raise OSError(errno.EINVAL, "no file can have this name", name) from None
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), name)
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "not a regular file but a pipe, a socket or a device", name)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: PathLike, limit: int, folder: Optional[int] = None) -> bytes:
    """Read a regular file whole.

    Args:
        path, folder: as for :func:`open_regular`.
        limit: in bytes; a file of this kind is never larger.

    Raises:
        OSError: as :func:`open_regular`, or the file is larger; ``strerror`` says which.
    """
    with open_regular(path, folder) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"{size} bytes, and no file of its kind has more than {limit}", os.fspath(path))
        return file.read(size)


def read_text(path: PathLike, limit: int) -> str:
    """Read a text of UTF-8, or of UTF-16 with its byte order mark, which is left out.

    Args:
        path, limit: as for :func:`read_regular`.

    Raises:
        OSError: as :func:`read_regular`.
        ValueError: it has another encoding; the message has the first such line.
    """
    data = read_regular(path, limit)
    is_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        return data.decode("utf-16" if is_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start)
        line = data.split(b"\n")[number].strip()
        raise ValueError(f"line {number + 1} is not in UTF-{16 if is_16 else 8}: {str(line[:100])[2:-1]}") from None


def write_whole(
    path: PathLike, data: Union[bytes, Callable[[BinaryIO], object]], folders: bool = False, mode: int = 0o666
) -> None:
    """Write a file atomically: to a temporary file beside it, flushed to the disk, then renamed.

    Several processes may write one file at once: it is always one's whole. An existing file stays until then. A link is
    replaced, not followed. What a killed process leaves, ``NAME.xxxxxxxx.part``, a write after an hour removes.

    Args:
        path: the file.
        data: its bytes, or what writes them.
        folders: make the folders above it.
        mode: of a new file, before the user's mask.

    Raises:
        LegsError: it cannot be written; the message says why.
    """
    name = os.fspath(path)
    part = f"{name}.{secrets.token_hex(4)}.part"
    try:
        if folders:
            os.makedirs(os.path.dirname(name) or ".", exist_ok=True)
        if os.path.lexists(name) and not (os.path.isfile(name) or os.path.islink(name)):
            raise OSError(errno.EINVAL, "a folder, a pipe, a socket or a device is there", name)
        _sweep(name)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        descriptor = os.open(part, flags, mode)
        try:
            with os.fdopen(descriptor, "wb") as file:
                data(file) if callable(data) else file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(part, name)
        except BaseException:
            with contextlib.suppress(OSError):  # what does not fit is not left to take room
                os.unlink(part)
            raise
    except OSError as error:
        raise LegsError(f"cannot write {name}: {error.strerror or error}") from None


def _sweep(name: str) -> None:
    """Remove what killed writers of a file left, by its age: a younger one may be of a writer that lives."""
    folder, base = os.path.split(os.path.abspath(name))
    for part in _parts(folder):
        if part[: -len(".01234567.part")] == base:
            path = os.path.join(folder, part)
            with contextlib.suppress(OSError):  # another may have removed it meanwhile
                if time.time() - os.lstat(path).st_mtime > _ABANDONED:
                    os.unlink(path)


@functools.lru_cache(maxsize=None)
def _parts(folder: str) -> List[str]:
    """List what writers left in a folder, once a process: it may get 100,000 files from it."""
    try:
        return [name for name in os.listdir(folder) if re.search(r"\.[0-9a-f]{8}\.part$", name)]
    except OSError:
        return []
