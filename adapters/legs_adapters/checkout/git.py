"""Ask git which files were changed, without running programs that the checkout names.

A checkout's ``.git/config`` and ``.gitattributes`` can name programs: filters, hooks, a file system monitor, a
transport. A clone brings no ``.git/config`` of its own; an archive can, and so can a bare repository inside a clone.
Git LFS, which is the user's own filter, runs what ``lfs.extension`` of that file names.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Dict, List, Optional, Set

from legs_loss import LegsError

__all__ = ["changed_files"]

_SECONDS = 60  # for all git commands; a pipe in the checkout would block them for ever
_OVERRIDES = {
    "core.fsmonitor": "",
    "core.hooksPath": os.devnull,
    "core.pager": "cat",
    "core.quotePath": "off",
    "safe.bareRepository": "explicit",
}
_ENVIRONMENT = {
    "GIT_OPTIONAL_LOCKS": "0",  # status writes nothing
    "GIT_ALLOW_PROTOCOL": "none",  # and fetches nothing, where objects are missing on purpose
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_TERMINAL_PROMPT": "0",
}
# What Git LFS writes to a checkout's settings, and where its files are: no program, unlike lfs.extension.
_OF_LFS_ITSELF = re.compile(r"lfs\.(repositoryformatversion|(push)?url|.*\.(access|locksverify))", re.S)


def changed_files(root: Path) -> List[str]:
    """Return the tracked files below a folder that differ from the last commit, relative to the folder.

    Empty outside of git, where git is missing, and where git does not trust the checkout's owner.

    Raises:
        LegsError: git times out.
    """
    until = time.monotonic() + _SECONDS
    off: Dict[str, str] = {}
    for driver in _own_filters(root, until):
        off.update({f"{driver}.{what}": "" for what in ("clean", "smudge", "process")})
        off[f"{driver}.required"] = "false"
    if any("=" in name for name in off):  # git cannot be told to leave a filter of such a name
        return []
    prefix = _git(root, until, off, "rev-parse", "--show-prefix")
    status = _git(
        root, until, off,
        "status", "--porcelain", "-z", "--untracked-files=no", "--ignore-submodules=all", "--no-renames", "--", ".",
    )  # fmt: skip
    if prefix is None or status is None:
        return []
    prefix = prefix.rstrip("\n")
    names = [entry[3:] for entry in status.split("\0") if len(entry) > 3]
    return [name[len(prefix) :] if name.startswith(prefix) else name for name in names]


def _own_filters(root: Path, until: float) -> Set[str]:
    """Return the filters that the checkout's own settings configure; the user's own, such as Git LFS, stay."""
    words = ("config", "-z", "--name-only", "--get-regexp", r"^(filter|lfs)\.")
    listed = _git(root, until, {}, "config", "--show-scope", *words[1:])
    if listed is None:  # there is no filter, or git is older than 2.26 and knows no scopes
        names = (_git(root, until, {}, *words) or "").split("\0")
    else:
        fields = listed.split("\0")
        names = [name for scope, name in zip(fields[::2], fields[1::2]) if scope in ("local", "worktree")]
    own = {name.rpartition(".")[0] for name in names if name.startswith("filter.")}
    lfs = any(name.startswith("lfs.") and not _OF_LFS_ITSELF.fullmatch(name) for name in names)
    return own | {"filter.lfs"} if lfs else own


def _git(root: Path, until: float, settings: Dict[str, str], *arguments: str) -> Optional[str]:
    """Run a git command and return what it printed; None where it failed.

    Raises:
        LegsError: it times out.
    """
    program = shutil.which("git")
    if program is None or root in Path(os.path.realpath(program)).parents:
        return None  # a "." on the path, or Windows, finds programs in the folder one is in
    options = [word for name, value in {**_OVERRIDES, **settings}.items() for word in ("-c", f"{name}={value}")]
    try:
        done = subprocess.run(
            [program, "--no-pager", *options, "-C", str(root), *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            timeout=max(until - time.monotonic(), 0.1),
            env={**os.environ, **_ENVIRONMENT},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise LegsError(
            f"git did not list the changed files of {root} within {_SECONDS} seconds; nothing was written: "
            "--force skips this check"
        ) from None
    except (OSError, ValueError):
        return None
    return done.stdout.decode("utf-8", "surrogateescape") if done.returncode == 0 else None
