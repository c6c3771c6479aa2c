"""Ask git what was committed, without running programs that the checkout names.

A checkout's ``.git/config`` and ``.gitattributes`` can name programs: filters, hooks, a file system monitor, a
transport. ``git ls-tree`` reads the last commit alone, which needs none of them; the bytes on the disk are hashed here.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
from pathlib import Path
from typing import List, Mapping

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
    program = shutil.which("git")
    if program is None or root in Path(os.path.realpath(program)).parents:
        return []  # a "." on the path, or Windows, finds programs in the folder one is in
    return [path for path, data in files.items() if _committed(program, root / path) not in (b"", *_blob_ids(data))]


def _committed(program: str, file: Path) -> bytes:
    """Return the name that git gives to what was committed last of a file; nothing where it was not."""
    command = [program, "--no-pager", *_SAFE, "-C", str(file.parent), "ls-tree", "-z", "HEAD", "--", file.name]
    try:
        listed = subprocess.run(
            command,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            timeout=_SECONDS, env={**os.environ, **_ENVIRONMENT},
        ).stdout  # fmt: skip
    except subprocess.TimeoutExpired:
        why = f"git did not find {file} in the last commit within {_SECONDS} seconds"
        raise LegsError(f"{why}; nothing was written: --force skips this check") from None
    except OSError:
        return b""
    return listed.partition(b"\t")[0].rpartition(b" ")[2]


def _blob_ids(data: bytes) -> List[bytes]:
    """Return the names that git may give to a file's bytes: as they are or with LF line ends, by SHA-1 or SHA-256."""
    blobs = [b"blob %d\0" % len(text) + text for text in (data, data.replace(b"\r\n", b"\n"))]
    return [digest(blob).hexdigest().encode() for blob in blobs for digest in (hashlib.sha1, hashlib.sha256)]
