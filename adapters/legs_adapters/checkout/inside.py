"""Reach a file of a checkout through its own folders, even while somebody swaps one of them for a link."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Iterator, Optional, Tuple

# Windows has no descriptors of folders: there paths are checked, then used.
BY_DESCRIPTOR = {os.open, os.rename, os.unlink, os.stat} <= os.supports_dir_fd


@contextlib.contextmanager
def folder_of(root: Path, path: str) -> Iterator[Tuple[Optional[int], str]]:
    """Open the folder of a file, part by part, none of them a link; yield its descriptor, and the file's name in it.

    Where the system has no such descriptors, yield None and the whole path: functions of ``os`` take both as they take
    the first two. An OSError meanwhile names the whole path.
    """
    if not BY_DESCRIPTOR:
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
