"""The journal of a patch, from which it is undone: the exact bytes from before, and the edits.

The journal is one file in the root of the checkout. A checkout and its journal may come from somebody else: a journal
names only files that legs-patch writes. What is read and what is about to be written pass the same checks.
"""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence

from legs_adapters.checkout.replace import MAX_FILE_BYTES, read_file
from legs_adapters.code.folders import check_name
from legs_adapters.code.limits import MAX_BYTES
from legs_adapters.settings import SETTINGS_FILE
from legs_adapters.terms.text import Edit, apply_edits
from legs_adapters.terms.writing import PACKAGE
from legs_loss import LegsError

JOURNAL = ".legs-patch.json"
MAX_EDITS, MAX_LAYERS = 100_000, 100  # of a file's patch, and patches of one file
_VERSION = 2
_NOTE = "What legs-patch changed here, and the bytes from before. legs-patch --undo needs it; do not edit it."


class Layer(NamedTuple):
    """One patch of one file: its bytes before, and the edits in order."""

    original: bytes
    edits: Sequence[Edit]

    @property
    def patched(self) -> bytes:
        """Its bytes after."""
        return apply_edits(self.original, self.edits)


class Journal(NamedTuple):
    """The patches of one checkout.

    Attributes:
        files: for each patched path its layers, the oldest first.
        created: files that a patch created, with what it wrote, and with what it wrote before.
        data: the file's bytes as they were read; None where there was no journal.
    """

    files: Dict[str, List[Layer]]
    created: Dict[str, List[bytes]]
    data: Optional[bytes] = None

    @classmethod
    def read(cls, root: Path) -> Journal:
        """Read a checkout's journal, of any author; an empty one if there is no file.

        Raises:
            LegsError: it cannot be read, has too many edits, or names files that legs-patch never writes.
        """
        data = read_file(root, JOURNAL)
        if data is None:
            return cls({}, {})
        advice = "nothing was changed; restore the files from git, and remove it"
        return cls._parsed(data, f"{root / JOURNAL} cannot be read", f": {advice}")

    @classmethod
    def _parsed(cls, data: bytes, problem: str, advice: str) -> Journal:
        """Check a journal's bytes, which are read or about to be written; a LegsError says what is wrong with them."""
        try:
            if len(data) > MAX_FILE_BYTES:
                raise ValueError(f"larger than {MAX_FILE_BYTES >> 20} MiB")
            content = json.loads(data.decode("utf-8"))
            if content["version"] != _VERSION:
                raise ValueError("written by another version of legs-patch: undo with that version")
            files = _read_files(content["files"])
            created = {name: [text.encode("utf-8") for text in texts] for name, texts in content["created"].items()}
            odd = [name for name in files if not name.endswith(".py")] + [*{*created} - {SETTINGS_FILE}]
            if odd:
                raise ValueError(f"{odd[0]!r} is not a Python file or {SETTINGS_FILE}, and legs-patch writes no others")
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError, zlib.error) as error:
            raise LegsError(f"{problem} ({error}){advice}") from None
        return cls(files, created, data)

    def add(self, path: str, layer: Layer) -> None:
        """Add a patch of a file; of a file that is as before an earlier patch, that and later ones are dropped."""
        layers = self.files.setdefault(path, [])
        is_bare = PACKAGE.encode() not in layer.original  # another version of the file, which no patch is in
        first = next((i for i, each in enumerate(layers) if is_bare or each.original == layer.original), len(layers))
        layers[first:] = [layer]

    def dump(self) -> bytes:
        """Return the file's content.

        Raises:
            LegsError: it would be refused where it is read.
        """
        files = {path: [_written(layer) for layer in layers] for path, layers in sorted(self.files.items())}
        created = {path: [text.decode("utf-8") for text in texts] for path, texts in self.created.items()}
        content: Dict[str, Any] = {"note": _NOTE, "version": _VERSION, "files": files, "created": created}
        data = (json.dumps(content, indent=1) + "\n").encode("utf-8")
        advice = "undo the earlier patches first, or leave large files out by --exclude"
        self._parsed(data, f"{JOURNAL} could not be read again", f", so nothing was written: {advice}")
        return data

    def is_as_written(self, path: str, data: bytes) -> bool:
        """Return whether a file's bytes are as the patch left them."""
        layers = self.files.get(path)
        return data == layers[-1].patched if layers else data in self.created.get(path, ())


def _written(layer: Layer) -> Dict[str, Any]:
    edits = [(edit.start, edit.end, edit.after.decode("utf-8")) for edit in layer.edits]
    return {"edits": edits, "original": base64.b64encode(zlib.compress(layer.original, 9)).decode("ascii")}


def _read_files(content: Dict[str, Any]) -> Dict[str, List[Layer]]:
    files: Dict[str, List[Layer]] = {}
    room = MAX_BYTES
    for name, layers in content.items():
        check_name(name)
        if len(layers) > MAX_LAYERS:
            raise ValueError(f"more than {MAX_LAYERS} patches of {name}")
        files[name] = []
        for layer in layers:
            files[name].append(_read_layer(layer, room))
            room -= len(files[name][-1].original)
    return files


def _read_layer(content: Dict[str, Any], room: int) -> Layer:
    """Read a layer whose file has at most ``room`` bytes."""
    stream = zlib.decompressobj()
    original = stream.decompress(base64.b64decode(content["original"], validate=True), room + 1)
    if len(original) > room or not stream.eof:
        raise ValueError(f"a file is cut off, or all are larger than {MAX_BYTES >> 20} MiB")
    if len(content["edits"]) > MAX_EDITS:
        raise ValueError(f"more than {MAX_EDITS} edits")
    edits: List[Edit] = []
    at = 0
    for start, end, text in sorted(content["edits"]):
        if type(start) is not int or type(end) is not int or not at <= start <= end <= len(original):
            raise ValueError(f"an edit of bytes {start!r} to {end!r} of {len(original)}")
        edits.append(Edit(start, end, text.encode("utf-8")))
        at = end
    return Layer(original, edits)
