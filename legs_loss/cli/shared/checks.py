"""Check a command's arguments before anything is computed."""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Sequence

from legs_loss.errors import LegsError
from legs_loss.scenes import View, image_size, training_size
from legs_loss.system.terminal import say

_TINY = 64  # pixels: a smaller width was probably meant as a divisor


def check_resolution(resolution: int, views: Sequence[View]) -> None:
    """Check ``-r``, and warn on stderr where it was probably meant as a divisor, as only 1, 2, 4 and 8 are.

    Raises:
        LegsError: no image has this resolution.
    """
    size = None
    with suppress(LegsError, OSError, IndexError):
        size = image_size(views[0].path)
    width, height = training_size(*(size or (1 << 20, 1 << 20)), resolution)
    if size is not None and resolution not in (-1, 1, 2, 4, 8) and width < min(_TINY, size[0]):
        why = "as in 3DGS, 1, 2, 4 and 8 divide the size, and any other number is the width"
        say(f"legs: warning: -r {resolution} makes images of {width}x{height} pixels: {why}", sys.stderr)


def check_empty(folder: Path) -> None:
    """Check that a folder for images is new or empty, so that none of the user's is replaced, and can be written.

    Raises:
        LegsError: it is not; the message says why.
    """
    check_writable(folder)
    if folder.exists() and any(folder.iterdir()):
        raise LegsError(f"{folder} is not empty: name another folder")


def check_writable(folder: Path) -> None:
    """Check that a folder can be made and written to; it is not made yet.

    Raises:
        LegsError: it cannot; the message says why.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        tempfile.TemporaryFile(dir=str(there)).close()
    except OSError as error:
        where = "" if there == folder else f": {there}"
        raise LegsError(f"cannot write to {folder}{where}: {error.strerror or error}") from None
