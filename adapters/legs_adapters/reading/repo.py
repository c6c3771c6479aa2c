"""Which files of a checkout may be read and rewritten: its own Python sources, and nothing that is not its own."""

from __future__ import annotations

import fnmatch
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Iterator, List, Sequence

from legs_adapters.reading.syntax import word_set
from legs_loss import LegsError

__all__ = ["Source", "Unreadable", "check_root", "read_source", "walk"]

BOM = b"\xef\xbb\xbf"

# Folders that hold other people's code, or none at all.
_FOREIGN = word_set(
    """
    .git .hg .svn __pycache__ .ipynb_checkpoints node_modules site-packages dist-packages build dist submodules
    third_party third-party thirdparty external externals extern venv env .venv .env tests test testing .tox .nox .eggs
    .mypy_cache .pytest_cache SIBR_viewers
    """
)
_TEST_FILE = re.compile(r"^(test_.*|.*_test|conftest)\.py$")
_CODING = re.compile(rb"^[ \t\f]*#.*?coding[:=][ \t]*([-\w.]+)")
_UTF8_NAMES = {"utf8", "utf-8", "utf_8", "u8", "utf8-sig", "utf-8-sig", "ascii", "us-ascii"}


@dataclass(frozen=True)
class Source:
    """One Python file, as it stands on disk.

    Attributes:
        path: relative to the root, posix separators.
        data: its exact bytes.
        text: what Python reads: decoded, without a byte order mark, line ends as they are.
    """

    path: str
    data: bytes
    text: str

    @property
    def bom(self) -> bytes:
        """The byte order mark, if the file starts with one."""
        return BOM if self.data.startswith(BOM) else b""


@dataclass(frozen=True)
class Unreadable:
    """A file that was left because it cannot be read as Python: reported, never fatal."""

    path: str
    reason: str


def check_root(path: str | os.PathLike[str]) -> Path:
    """Return the folder to work in, absolute.

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


def walk(root: Path, exclude: Sequence[str] = ()) -> Iterator[str]:
    """Yield the paths of the checkout's own Python files, relative, posix separators, a folder's own files first.

    Links are not followed, whether to files or to folders; left out are ``.git``, submodules, virtual environments,
    vendored folders, tests, and what ``exclude`` names: globs on the relative path or, without a slash, on the name of
    the file or of a folder above it.
    """
    submodules = set(_submodules(root))
    for folder, folders, files in os.walk(str(root), followlinks=False):
        here = Path(folder).relative_to(root).as_posix()
        prefix = "" if here == "." else here + "/"
        folders[:] = sorted(
            name
            for name in folders
            if name not in _FOREIGN
            and prefix + name not in submodules
            and not _excluded(prefix + name, exclude)
            and not os.path.islink(os.path.join(folder, name))
            and not os.path.exists(os.path.join(folder, name, "pyvenv.cfg"))
            and not os.path.lexists(os.path.join(folder, name, ".git"))
        )
        for name in sorted(files):
            path = prefix + name
            full = os.path.join(folder, name)
            if not name.endswith(".py") or _TEST_FILE.match(name) or _excluded(path, exclude):
                continue
            if os.path.islink(full) or not os.path.isfile(full):
                continue
            yield path


def read_source(root: Path, path: str) -> Source | Unreadable:
    """Read one file; what cannot be read as UTF-8 is returned with its reason."""
    try:
        data = (root / path).read_bytes()
    except OSError as error:
        return Unreadable(path, f"cannot be read: {error.strerror}")
    return decode(path, data)


def decode(path: str, data: bytes) -> Source | Unreadable:
    """Decode a file's bytes as Python would, if it is UTF-8."""
    for line in data[len(BOM) if data.startswith(BOM) else 0 :].split(b"\n")[:2]:
        match = _CODING.match(line)
        if match is not None:
            name = match.group(1).decode("ascii", "replace").lower()
            if name not in _UTF8_NAMES:
                return Unreadable(path, f"not UTF-8 (it declares {name})")
            break
        if line.strip() and not line.lstrip().startswith(b"#"):
            break
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return Unreadable(path, f"not UTF-8 (byte {error.start})")
    return Source(path, data, text)


def _excluded(path: str, patterns: Sequence[str]) -> bool:
    parts = path.split("/")
    for pattern in patterns:
        pattern = pattern.rstrip("/")
        if any(fnmatch.fnmatch("/".join(parts[: i + 1]), pattern) for i in range(len(parts))):
            return True
        if "/" not in pattern and fnmatch.fnmatch(parts[-1], pattern):
            return True
    return False


def _submodules(root: Path) -> List[str]:
    try:
        text = (root / ".gitmodules").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    return [match.strip().rstrip("/") for match in re.findall(r"^\s*path\s*=\s*(.+)$", text, re.M)]
