"""A checkout and its files on disk: bytes, and the text that Python decodes."""

from __future__ import annotations

import errno
import io
import os
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import List, Sequence, Tuple

from legs_adapters.code.folders import CLOSED, check_name, folders_of
from legs_adapters.code.limits import MAX_BYTES, MAX_FILE_BYTES
from legs_loss import LegsError
from legs_loss.system.files import read_regular


@dataclass(frozen=True)
class Source:
    """One Python file on disk.

    Attributes:
        path: relative to the root, posix separators.
        data: its exact bytes.
        text: decoded as Python does, without a byte order mark, line ends unchanged.
    """

    path: str
    data: bytes
    text: str


@dataclass(frozen=True)
class Unreadable:
    """A file that cannot be read as Python: reported, never fatal."""

    path: str
    reason: str


def check_root(path: str | os.PathLike[str]) -> Path:
    """Return the checkout's folder, absolute.

    Raises:
        LegsError: it is not a folder, or it is the root of the file system.
    """
    root = Path(path)
    if not root.is_dir():
        what = "is a file: give the folder of the checkout" if root.exists() else "does not exist"
        raise LegsError(f"{path} {what}")
    root = root.resolve()
    if root == root.parent:
        raise LegsError(f"{root} is the root of the file system: give the folder of one checkout")
    return root


def read_files(root: Path, exclude: Sequence[str]) -> Tuple[List[Source], List[Unreadable]]:
    """Read the Python files of a checkout, except for excluded ones; return them, and those that cannot be read.

    Raises:
        LegsError: they are too large together.
    """
    readable: List[Source] = []
    unreadable: List[Unreadable] = []
    size = 0
    for files, skipped in folders_of(root, exclude, (".py", ".ipynb")):
        unreadable += [Unreadable(folder.path, folder.why) for folder in skipped if folder.why == CLOSED]
        for source in (read_source(root, path) for path in files):
            if isinstance(source, Unreadable):
                unreadable += [source] if source.reason else []
                continue
            readable.append(source)
            size += len(source.data)
            if size > MAX_BYTES:
                raise LegsError(f"its Python files have more than {MAX_BYTES >> 20} MiB: leave some out by --exclude")
    return readable, unreadable


def read_source(root: Path, path: str) -> Source | Unreadable:
    """Read one file; one that is not UTF-8, or has a name that is never written, is returned with the reason.

    A notebook that does not train has none.
    """
    try:
        check_name(path)
        data = read_regular(root / path, MAX_FILE_BYTES)
    except LegsError:
        return Unreadable(path, "legs-patch writes no file of this name: rename it")
    except OSError as error:
        large = f"larger than {MAX_FILE_BYTES >> 20} MiB" if error.errno == errno.EFBIG else ""
        return Unreadable(path, large or f"cannot be read: {error.strerror}")
    if path.endswith(".ipynb"):
        trains = b"backward(" in data
        return Unreadable(path, "a notebook: export it (jupyter nbconvert --to script)" if trains else "")
    return decode(path, data)


def decode(path: str, data: bytes) -> Source | Unreadable:
    """Decode a file's bytes as Python would, if it is UTF-8."""
    try:
        text = data.decode("utf-8-sig")
        encoding = tokenize.detect_encoding(io.BytesIO(data).readline)[0]
    except UnicodeDecodeError as error:
        return Unreadable(path, f"not UTF-8 (byte {error.start})")
    except SyntaxError as error:
        return Unreadable(path, f"not UTF-8 ({error})")
    if encoding not in ("utf-8", "utf-8-sig", "ascii", "us-ascii"):
        return Unreadable(path, f"not UTF-8 (it declares {encoding})")
    return Source(path, data, text)
