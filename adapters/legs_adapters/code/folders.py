"""List the Python files of a checkout, and the folders of it that are not entered, with the reason."""

from __future__ import annotations

import fnmatch
import os
import re
import unicodedata
from pathlib import Path, PurePosixPath
from typing import Iterator, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_loss import LegsError
from legs_loss.system.files import read_regular

VENDORED, SUBMODULE = "third-party code", "a submodule"
WORKTREE, LINK, _TESTS = "another worktree of this checkout", "a link", "a folder of tests"
CLOSED = "cannot be read: Permission denied"
_BY_REASON = {
    VENDORED: "submodules third_party third-party thirdparty external externals extern SIBR_viewers"
    " croco dust3r mast3r vggt",  # models that a checkout uses, some with trainers of their own beside
    _TESTS: "tests test testing",
    "installed packages": "site-packages dist-packages node_modules venv env .venv .env .tox .nox .eggs",
    "tool output": ".git .hg .svn __pycache__ .legs-patch.tmp .ipynb_checkpoints build dist .mypy_cache .pytest_cache",
}
_FOREIGN = {name: why for why, names in _BY_REASON.items() for name in names.split()}
PATCHABLE = (VENDORED, _TESTS, SUBMODULE, WORKTREE, LINK)
_LARGEST = 1 << 20  # bytes of a .gitmodules, or of a .git that is a file
_TEST_FILE = re.compile(r"^(test_.*|conftest)\.py$")


class Skipped(NamedTuple):
    """A folder that is not searched, relative to the root, and the reason."""

    path: str
    why: str


def walk(root: Path, exclude: Sequence[str] = (), ends: Tuple[str, ...] = (".py",)) -> Iterator[str]:
    """Yield the paths of the checkout's own Python files, relative, posix separators, a folder's own files first.

    A nested checkout belongs to it. Links are not followed, whether to files or to folders; skipped are ``.git``,
    submodules, other worktrees, virtual environments, vendored folders, tests, and what ``exclude`` names: globs on the
    relative path or, without a slash, on the name of the file or of a folder above it.
    """
    for files, _ in folders_of(root, exclude, ends):
        yield from files


def why_left_out(root: Path, path: str, exclude: Sequence[str] = ()) -> Optional[str]:
    """Return why ``walk`` skips a file of the checkout; None where it yields it."""
    if path in walk(root, exclude):
        return None
    foreign = foreign_folder(root, path)
    if foreign is None:
        return "it is not searched: excluded, not a .py file, a test or a link"
    instead = ": run legs-patch on that folder" if foreign.why in PATCHABLE else ""
    return f"{foreign.path} is not searched ({foreign.why}){instead}"


def foreign_folder(root: Path, path: str) -> Optional[Skipped]:
    """Return the skipped folder that a file is in, below third_party the inner one; None without one."""
    submodules = _submodules(root, "")
    folders = [folder.as_posix() for folder in reversed(PurePosixPath(path).parents)][1:]
    for folder, inner in zip(folders, [*folders[1:], ""]):
        why = LINK if os.path.islink(str(root / folder)) else _why_foreign(root, folder, submodules)
        submodules |= _submodules(root, folder)
        if why == VENDORED and inner:
            return Skipped(inner, _why_foreign(root, inner, submodules) or why)
        if why is not None:
            return Skipped(folder, why)
    return None


def folders_of(
    root: Path, exclude: Sequence[str], ends: Tuple[str, ...] = (".py",)
) -> Iterator[Tuple[List[str], List[Skipped]]]:
    """Yield, a folder at a time, the Python files in it, and the folders in it that are not entered."""
    submodules: Set[str] = set()
    for here, folders, names in os.walk(str(root), followlinks=False):
        relative = Path(here).relative_to(root)
        submodules |= _submodules(root, relative.as_posix()) if ".gitmodules" in names else set()
        paths = {(relative / name).as_posix(): name for name in sorted([*folders, *names])}
        named = [path for path in paths if not _excluded(path, exclude)]
        own = [path for path in named if not os.path.islink(str(root / path))]
        why = {path: _why_foreign(root, path, submodules) for path in own if paths[path] in folders}
        folders[:] = [paths[path] for path, reason in why.items() if reason is None]
        files = [path for path in own if path.endswith(ends) and not _TEST_FILE.match(paths[path])]
        regular = [path for path in files if path not in why and os.path.isfile(str(root / path))]
        links = [Skipped(path, LINK) for path in named if path not in own and _leads_to_code(root, path)]
        yield regular, links + [Skipped(path, reason) for path, reason in why.items() if reason is not None]


def _leads_to_code(root: Path, path: str) -> bool:
    """Return whether a link leads to a folder of code outside of the root. Names are looked at there, and no file."""
    try:
        names, target = os.listdir(str(root / path)), (root / path).resolve()
    except (OSError, RuntimeError):  # to nothing, to a file, or to itself
        return False
    return root not in (target, *target.parents) and any(name == ".git" or name.endswith(".py") for name in names)


def _why_foreign(root: Path, path: str, submodules: Set[str]) -> Optional[str]:
    """Return why a folder is skipped; None for the checkout's own code."""
    name = ".git" if _is_dot_git(os.path.basename(path)) else os.path.basename(path)
    if path in submodules or name in _FOREIGN:
        return SUBMODULE if path in submodules else _FOREIGN[name]
    if not os.access(str(root / path), os.R_OK | os.X_OK):
        return CLOSED
    if (root / path / "pyvenv.cfg").exists():
        return "a virtual environment"
    return _why_not_own(root / path)


def _why_not_own(folder: Path) -> Optional[str]:
    """Return why a folder with a ``.git`` is no nested checkout; None where it is one, or has none."""
    try:
        text = read_regular(folder / ".git", _LARGEST).decode("utf-8", "replace")
    except OSError:  # a folder, of a checkout of its own; or there is none
        return None
    kept = Path(os.path.normpath(str(folder / text.partition("gitdir:")[2].strip())))
    inside = kept.parts[kept.parts.index(".git") :] if ".git" in kept.parts else ()
    outer = any(above / ".git" in kept.parents for above in folder.parents)
    return SUBMODULE if "modules" in inside else WORKTREE if outer else None


def _excluded(path: str, patterns: Sequence[str]) -> bool:
    parts = path.split("/")
    names = [*parts, *("/".join(parts[: i + 1]) for i in range(len(parts)))]
    return any(fnmatch.fnmatch(name, pattern.rstrip("/")) for pattern in patterns for name in names)


def _submodules(root: Path, folder: str) -> Set[str]:
    """Return the submodules that a folder's ``.gitmodules`` names."""
    try:
        text = read_regular(root / folder / ".gitmodules", _LARGEST).decode("utf-8", "replace")
    except OSError:
        return set()
    found = (line.partition("=") for line in text.splitlines())
    return {(PurePosixPath(folder) / path.strip()).as_posix() for key, _, path in found if key.strip() == "path"}


def check_name(path: str) -> None:
    """Check that a relative path is normalised and has no ``.git`` in it.

    Raises:
        LegsError: it is not, or it has.
    """
    parts = path.split("/")
    odd = any(part in ("", ".", "..") for part in parts) or any(letter in path for letter in "\0\n\r\\")
    if odd or os.path.isabs(path) or os.path.splitdrive(path)[0]:
        raise LegsError(f"{path!r} is not the path of a file in the checkout")
    if any(_is_dot_git(part) for part in parts):
        raise LegsError(f"{path!r} is in .git, where legs-patch changes nothing")


def _is_dot_git(part: str) -> bool:
    """Return whether some file system resolves a name to ``.git``.

    They ignore case, trailing dots and spaces, resolve short names and streams (NTFS), and ignore invisible letters
    (HFS+).
    """
    seen = "".join(letter for letter in part if unicodedata.category(letter) != "Cf")
    return seen.split(":")[0].rstrip(". ").casefold() in (".git", "git~1")


def first_of(names: Sequence[str], most: int, between: str = ", ") -> str:
    """Return the first of some names, and how many more there are."""
    return between.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
