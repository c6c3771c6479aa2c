"""Reading files that may be anything: a pipe, a device, or far larger than such a file can be."""

from __future__ import annotations

import errno
import os
import stat
from typing import BinaryIO, Union

__all__ = ["open_regular", "read_regular"]

PathLike = Union[str, "os.PathLike[str]"]


def open_regular(path: PathLike) -> BinaryIO:
    """Open a regular file for reading; never wait for a pipe's other end.

    Raises:
        OSError: it cannot be opened, or is a folder, a pipe, a socket or a device; ``strerror`` says which.
    """
    name = os.fspath(path)
    try:
        descriptor = os.open(name, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
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


def read_regular(path: PathLike, limit: int) -> bytes:
    """Read a regular file whole.

    Args:
        path: the file.
        limit: in bytes; a file of this kind is never larger.

    Raises:
        OSError: as :func:`open_regular`, or the file is larger; ``strerror`` says which.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > limit:
            raise OSError(errno.EFBIG, f"{size} bytes, and no file of its kind has more than {limit}", os.fspath(path))
        return file.read(size)
