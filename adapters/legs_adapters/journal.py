"""The journal of a patch, from which it is undone: the exact bytes from before, and the edits.

The journal is one file in the root of the checkout. A checkout and its journal may come from somebody else:
a journal names only files that legs-patch writes, and it is sealed (:mod:`legs_adapters.checkout.seal`).
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import zlib
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

from legs_adapters.checkout.replace import LARGEST, read_file
from legs_adapters.checkout.seal import is_sealed, seal
from legs_adapters.code.folders import check_name
from legs_adapters.settings import SETTINGS_FILE
from legs_loss import LegsError

__all__ = ["JOURNAL", "Journal", "Layer", "digest"]

JOURNAL = ".legs-patch.json"
_VERSION = 1
_MOST = 1000  # patches of one file
_NOTE = "What legs-patch changed here, and the bytes from before. legs-patch --undo needs it; do not edit it."
_DIGEST = re.compile(r"[0-9a-f]{64}")


class Layer(NamedTuple):
    """One patch of one file: its bytes before, the edits in order, and the checksum of the bytes after."""

    original: bytes
    edits: Tuple[Tuple[int, int, str], ...]
    after: str

    def patched(self) -> bytes:
        """Return the bytes that the patch wrote."""
        parts, at = [], 0
        for start, end, text in self.edits:
            parts += [self.original[at:start], text.encode("utf-8")]
            at = end
        return b"".join([*parts, self.original[at:]])


class Journal:
    """The patches of one checkout.

    Attributes:
        files: for each patched path its layers, the oldest first.
        created: files that a patch created, with the checksum of what it wrote.
        data: the file's bytes as they were read; None where there was no journal.
        ours: whether this user wrote it; an empty journal is.
    """

    def __init__(
        self, files: Dict[str, List[Layer]], created: Dict[str, str], data: Optional[bytes] = None, ours: bool = True
    ) -> None:
        self.files = files
        self.created = created
        self.data = data
        self.ours = ours

    @classmethod
    def read(cls, root: Path) -> Journal:
        """Read a checkout's journal, of any author; an empty one if there is no file.

        Raises:
            LegsError: it cannot be read, or names files that legs-patch never writes.
        """
        data = read_file(root, JOURNAL)
        if data is None:
            return cls({}, {})
        path = root / JOURNAL
        try:
            content = json.loads(data.decode("utf-8"))
            if content["version"] != _VERSION:
                raise LegsError(f"{path} was written by another version of legs-patch: undo with that version")
            claimed = content.pop("seal", None)
            ours = is_sealed(_canonical(content), claimed, root)
            files, created = _read_files(content["files"]), _read_created(content["created"])
        except LegsError as error:
            raise LegsError(f"{error}; {path}: nothing was changed" if str(path) not in str(error) else error) from None
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError, zlib.error) as error:
            raise LegsError(f"{path} cannot be read ({error}): restore the files from git, and remove it") from None
        return cls(files, created, data, ours)

    def dump(self, root: Path) -> bytes:
        """Return the file's content, sealed; without a seal where this machine keeps no key."""
        content: Dict[str, Any] = {
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
        sealed = seal(_canonical(content), root)
        if sealed is not None:
            content["seal"] = sealed
        return (json.dumps(content, indent=1) + "\n").encode("utf-8")

    def wrote(self, path: str, data: bytes) -> bool:
        """Return whether a file's bytes are as the patch left them."""
        layers = self.files.get(path)
        known = layers[-1].after if layers else self.created.get(path)
        return known == digest(data)

    @property
    def name(self) -> str:
        """The name by which ``--trust`` accepts this journal: the start of its checksum."""
        return digest(self.data or b"")[:16]


def digest(data: bytes) -> str:
    """Return the checksum that the journal keeps of a file."""
    return hashlib.sha256(data).hexdigest()


def _canonical(content: Any) -> bytes:
    return json.dumps(content, sort_keys=True, separators=(",", ":")).encode("ascii")


def _read_files(content: Dict[str, Any]) -> Dict[str, List[Layer]]:
    files: Dict[str, List[Layer]] = {}
    room = LARGEST
    for name, layers in content.items():
        check_name(name)
        if not name.endswith(".py"):
            raise LegsError(f"{name!r} is not a Python file, and legs-patch patches no others")
        files[name] = []
        if len(layers) > _MOST:
            raise ValueError(f"{name} was patched {len(layers)} times")
        for layer in layers:
            files[name].append(_read_layer(layer, room))
            room -= len(files[name][-1].original)
    return files


def _read_layer(content: Dict[str, Any], room: int) -> Layer:
    original = _unpack(content["original"], room)
    edits: List[Tuple[int, int, str]] = []
    at = 0
    for start, end, text in sorted(content["edits"]):
        if type(start) is not int or type(end) is not int or not at <= start <= end <= len(original):
            raise ValueError(f"an edit of bytes {start!r} to {end!r} of {len(original)}")
        text.encode("utf-8")
        edits.append((start, end, text))
        at = end
    return Layer(original, tuple(edits), _checksum(content["after"]))


def _read_created(content: Dict[str, Any]) -> Dict[str, str]:
    for name in content:
        if name != SETTINGS_FILE:
            raise LegsError(f"{name!r} is not {SETTINGS_FILE}, and legs-patch creates no other file")
    return {name: _checksum(value) for name, value in content.items()}


def _checksum(value: Any) -> str:
    if not isinstance(value, str) or not _DIGEST.fullmatch(value):
        raise ValueError("an invalid checksum")
    return value


def _pack(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def _unpack(text: str, room: int) -> bytes:
    """Decompress a file, up to a size limit."""
    stream = zlib.decompressobj()
    data = stream.decompress(base64.b64decode(text, validate=True), max(room, 0) + 1)
    if len(data) > room:
        raise ValueError(f"its files are larger than {LARGEST >> 20} MiB")
    if not stream.eof:
        raise ValueError("a file is truncated")
    return data
