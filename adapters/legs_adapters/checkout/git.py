"""Ask git what was committed, without running programs that the checkout names.

A checkout's ``.git/config`` and ``.gitattributes`` can name programs: filters, hooks, a file system monitor, a
transport. ``git ls-tree`` reads the last commit alone, which needs none of them; the bytes on the disk are hashed here.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path, PurePosixPath
from typing import Dict, List, Mapping

from legs_loss import LegsError

_SECONDS = 60  # a pipe in .git would block git for ever
_SAFE = ("-c", "safe.bareRepository=explicit", "-c", "safe.directory=*")
_ENVIRONMENT = {
    "GIT_ALLOW_PROTOCOL": "none",  # objects that are missing on purpose are not fetched
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_LITERAL_PATHSPECS": "1",
}


def changed_files(root: Path, files: Mapping[str, bytes]) -> List[str]:
    """Return which of these files differ from the last commit, in more than their line ends.

    Git is asked in each file's own folder, so that of a nested checkout answers for its files. A file that was never
    committed counts as unchanged; so do all outside of git, and where git is missing. Whose the checkout is does not
    matter: nothing of it is run.

    Raises:
        LegsError: git times out.
    """
    by_folder: Dict[PurePosixPath, Dict[str, bytes]] = {}
    for path in map(PurePosixPath, files):
        by_folder.setdefault(path.parent, {})[path.name] = files[path.as_posix()]
    found = ((at, _changed(root, root / at, inner)) for at, inner in by_folder.items())
    return [(at / name).as_posix() for at, names in found for name in names]


def _changed(root: Path, folder: Path, files: Mapping[str, bytes]) -> List[str]:
    """Return which files of one folder differ from the last commit."""
    program = shutil.which("git")
    if program is None or root in Path(os.path.realpath(program)).parents:
        return []  # a "." on the path, or Windows, finds programs in the folder one is in
    command = [program, "--no-pager", *_SAFE, "-C", str(folder), "ls-tree", "-z", "HEAD"]
    try:
        listed = subprocess.run(
            [*command, "--", *files],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            timeout=_SECONDS, env={**os.environ, **_ENVIRONMENT},
        ).stdout  # fmt: skip
    except subprocess.TimeoutExpired:
        why = f"git did not list the last commit of {folder} within {_SECONDS} seconds"
        raise LegsError(f"{why}; nothing was written: --force skips this check") from None
    except OSError:
        return []
    entries = [entry.partition("\t") for entry in listed.decode("utf-8", "surrogateescape").split("\0")]
    committed = {name: words.rpartition(" ")[2] for words, _, name in entries}
    return [name for name, data in files.items() if committed.get(name) not in (None, *_blob_ids(data))]


def _blob_ids(data: bytes) -> List[str]:
    """Return the names that git may give to a file's bytes: as they are or with LF line ends, by SHA-1 or SHA-256."""
    blobs = [b"blob %d\0" % len(text) + text for text in (data, data.replace(b"\r\n", b"\n"))]
    return [digest(blob).hexdigest() for blob in blobs for digest in (hashlib.sha1, hashlib.sha256)]
