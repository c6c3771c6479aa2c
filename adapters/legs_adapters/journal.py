"""What was edited, so that it can be taken back: the exact bytes from before, and what they became.

The journal is one file in the root of the checkout. Every write goes through :func:`replace_files`, all or nothing.
"""

from __future__ import annotations

import base64
import contextlib
import difflib
import hashlib
import json
import os
import shutil
import tempfile
import zlib
from pathlib import Path
from typing import Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple

from legs_loss import LegsError

__all__ = ["JOURNAL", "Journal", "Layer", "replace_files", "undo_edits"]

JOURNAL = ".legs-patch.json"
_VERSION = 1
_NOTE = "What legs-patch changed here, and the bytes from before. legs-patch --undo needs it; do not edit it."


class Layer(NamedTuple):
    """One patch of one file: its bytes before, what was put where, and the checksum of what they became."""

    original: bytes
    edits: Tuple[Tuple[int, int, str], ...]
    after: str

    def patched(self) -> bytes:
        """Return the bytes that the patch wrote."""
        data = self.original
        for start, end, text in sorted(self.edits, reverse=True):
            data = data[:start] + text.encode("utf-8") + data[end:]
        return data


class Journal:
    """The patches of one checkout.

    Attributes:
        files: for each patched path its layers, the oldest first.
        created: files that a patch created, with the checksum of what it wrote.
    """

    def __init__(self, files: Dict[str, List[Layer]], created: Dict[str, str]) -> None:
        self.files = files
        self.created = created

    @classmethod
    def read(cls, root: Path) -> Journal:
        """Read a checkout's journal; an empty one where there is none.

        Raises:
            LegsError: it is there and cannot be read.
        """
        path = root / JOURNAL
        if not path.is_file() or path.is_symlink():
            return cls({}, {})
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content["version"] != _VERSION:
                raise LegsError(f"{path} was written by another version of legs-patch: undo with that one")
            files = {
                str(name): [
                    Layer(
                        _unpack(layer["original"]), tuple((a, b, c) for a, b, c in layer["edits"]), str(layer["after"])
                    )
                    for layer in layers
                ]
                for name, layers in content["files"].items()
            }
            created = {str(name): str(digest) for name, digest in content["created"].items()}
        except LegsError:
            raise
        except Exception as error:
            raise LegsError(f"{path} cannot be read ({error}): restore the files from git, and remove it") from None
        for name in (*files, *created):
            if os.path.isabs(name) or ".." in name.split("/") or name.split("/")[0] == ".git":
                raise LegsError(f"{path} names {name!r}, which is outside of the checkout: nothing was changed")
        return cls(files, created)

    def dump(self) -> Optional[bytes]:
        """Return the file's content; None where there is nothing to remember."""
        if not self.files and not self.created:
            return None
        content = {
            "note": _NOTE,
            "version": _VERSION,
            "files": {
                name: [
                    {"after": layer.after, "edits": layer.edits, "original": _pack(layer.original)} for layer in layers
                ]
                for name, layers in sorted(self.files.items())
            },
            "created": dict(sorted(self.created.items())),
        }
        return (json.dumps(content, indent=1) + "\n").encode("utf-8")

    def wrote(self, path: str, data: bytes) -> bool:
        """Return whether a file's bytes are as the patch left them."""
        layers = self.files.get(path)
        known = layers[-1].after if layers else self.created.get(path)
        return known == digest(data)


def digest(data: bytes) -> str:
    """Return the checksum that the journal keeps of a file."""
    return hashlib.sha256(data).hexdigest()


def undo_edits(original: bytes, patched: bytes, current: bytes) -> Tuple[bytes, List[str]]:
    """Put a patch's own lines back in a file that was edited since.

    Args:
        original, patched: the file before and after the patch.
        current: the file as it stands.

    Returns:
        The file with the patch's lines as they were and the edits as they are; and the patched lines that are no
        longer there as the patch left them, which were left alone.
    """
    before, after, lines = (data.splitlines(keepends=True) for data in (original, patched, current))
    lost: List[str] = []
    hunks = difflib.SequenceMatcher(None, before, after, autojunk=False).get_opcodes()
    kept = difflib.SequenceMatcher(None, after, lines, autojunk=False).get_matching_blocks()
    where = {block.a + i: block.b + i for block in kept for i in range(block.size)}
    changes: List[Tuple[int, int, Sequence[bytes]]] = []
    for tag, i1, i2, j1, j2 in hunks:
        if tag == "equal":
            continue
        places = [where.get(j) for j in range(j1, j2)]
        if j1 == j2 or None in places or places != list(range(places[0], places[0] + j2 - j1)):  # type: ignore[arg-type,operator]
            lost.extend(line.decode("utf-8", "replace").strip() for line in after[j1:j2])
            continue
        assert places[0] is not None
        changes.append((places[0], places[0] + j2 - j1, before[i1:i2]))
    for start, end, put in reversed(changes):
        lines[start:end] = put
    return b"".join(lines), lost


def replace_files(root: Path, changes: Mapping[str, Tuple[Optional[bytes], Optional[bytes]]]) -> None:
    """Replace files, each atomically, and all of them or none.

    Args:
        changes: by relative path, in order: the bytes expected there now (None: no file) and the bytes to put there
            (None: remove the file).

    Raises:
        LegsError: a file is not as expected, or cannot be written; then all are as they were.
    """
    for path, (expected, _) in changes.items():
        _check_inside(root, path)
        if _read(root / path) != expected:
            raise LegsError(f"{path} changed while legs-patch was at work: nothing was written; run it again")
    staged: Dict[str, str] = {}
    done: List[str] = []
    try:
        for path, (_, data) in changes.items():
            if data is not None:
                staged[path] = _stage(root / path, data)
        for path, (_, data) in changes.items():
            done.append(path)
            if data is None:
                (root / path).unlink()
            else:
                os.replace(staged[path], str(root / path))
    except BaseException as error:
        for path in reversed(done):
            _restore(root / path, changes[path][0])
        if isinstance(error, OSError):
            raise LegsError(f"{error.filename or root}: {error.strerror}; nothing was changed") from None
        raise
    finally:
        for name in staged.values():
            with contextlib.suppress(OSError):
                os.unlink(name)


def _stage(path: Path, data: bytes) -> str:
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".legs-patch", dir=str(path.parent))
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(str(path), name)
        else:
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(name, 0o666 & ~umask)
    except BaseException:
        os.unlink(name)
        raise
    return name


def _restore(path: Path, data: Optional[bytes]) -> None:
    if _read(path) == data:
        return
    if data is None:
        path.unlink()
    else:
        os.replace(_stage(path, data), str(path))


def _read(path: Path) -> Optional[bytes]:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None


def _check_inside(root: Path, path: str) -> None:
    full = root / path
    if full.is_symlink() or root not in (full.resolve(), *full.resolve().parents):
        raise LegsError(f"{path} is a link: legs-patch follows none")


def _pack(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def _unpack(text: str) -> bytes:
    return zlib.decompress(base64.b64decode(text))
