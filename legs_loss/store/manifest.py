"""The manifest of a store: the list of its maps, checked when it is read.

It is JSON, one sorted line per entry, with a checksum: any changed byte is detected. A checksum detects damage, not
malice, so every field is checked as well.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Dict, Iterable, List, Optional, Tuple

from legs_loss.errors import LegsError
from legs_loss.system.files import read_regular
from legs_loss.system.values import is_count, is_number, is_text

MANIFEST = "manifest.json"
MASK, WEIGHTS = "mask", "weights"  # in place of an operator: of the maps that are the user's own
VERSION = 3  # 1 and 2 had fewer fields
_LARGEST = 256 << 20  # bytes: some 500,000 entries
_SIDE = 1 << 20  # pixels
_FILE_NAME = re.compile(r"[0-9a-z_]+-[0-9a-f]{16}\.npy")
_CHECKSUM = re.compile(r"[0-9a-f]{64}")


class DamagedStoreError(LegsError):
    """A file of a store is damaged or missing."""


@dataclass(frozen=True)
class Entry:
    """A stored map, and what it was made from.

    Attributes:
        view: the photograph's path relative to the scene, forward slashes.
        width, height: of the map in pixels.
        operator, p, eps: the settings of its response. :data:`MASK` and :data:`WEIGHTS`, with p 1 and eps 0, are the
            user's own maps: of a view at a size, whatever its photograph; they have no fingerprint and no source.
        background: "black" or "white" where the photograph was laid on one, else None.
        fingerprint: of the training image (:func:`fingerprint`).
        source_bytes, source_mtime_ns: size and time of the photograph's file.
        file: the map's file in the store.
        bytes, sha256: size and checksum of that file.
        smooth: of its response too: the Gaussian before the operator.
        low, span: the response that E^ was made from is low + span * E^; None, as the next ones, where the map was not
            made to be normalised over its scene. Of the user's weights, too, whose map is divided by their largest.
        percentile: of the level ``strong``.
        median, strong: the view's levels (:mod:`legs_loss.responses`); of the user's weights 0 and ``span``.
        sample: of the training image (:func:`sampled_fingerprint`), "" from before version 3.
    """

    view: str
    width: int
    height: int
    operator: str
    p: float
    eps: float
    background: Optional[str]
    fingerprint: str
    source_bytes: int
    source_mtime_ns: int
    file: str = ""
    bytes: int = 0
    sha256: str = ""
    smooth: float = 0.0
    low: Optional[float] = None
    span: Optional[float] = None
    percentile: Optional[float] = None
    median: Optional[float] = None
    strong: Optional[float] = None
    sample: str = ""

    @property
    def is_users(self) -> bool:
        """Return whether the map is a mask or weights of the user's."""
        return self.operator in (MASK, WEIGHTS)

    @property
    def key(self) -> Tuple[Any, ...]:
        """Return what tells a map from all others: a view at a size with an operator."""
        return self.view, self.height, self.width, self.operator, self.p, self.eps, self.smooth


_STRONGEST = 1e6  # response: images are in [0, 1]; weights of larger ones would overflow
_LEVELS = ("low", "span", "percentile", "median", "strong")
# What is not written: it came with later versions, and few maps have it.
_ABSENT = {"smooth": 0.0, **dict.fromkeys(_LEVELS), "sample": ""}


def _is_level(value: Any) -> bool:
    return value is None or (type(value) is float and 0 <= value <= _STRONGEST)


# What a field may be. Type by type: JSON's true is an int, and 1.0 == 1.
_FIELDS: Dict[str, Callable[[Any], bool]] = {
    "view": lambda value: is_text(value) and value != "",
    "width": lambda value: type(value) is int and 0 < value <= _SIDE,
    "height": lambda value: type(value) is int and 0 < value <= _SIDE,
    "operator": lambda value: type(value) is str,
    "p": lambda value: type(value) is float and value > 0,
    "eps": lambda value: is_number(value) and 0 <= value < math.inf,
    "background": lambda value: value in (None, "black", "white"),
    "fingerprint": lambda value: type(value) is str,
    "source_bytes": is_count,
    "source_mtime_ns": is_number,
    "file": lambda value: type(value) is str and is_map_name(value),
    "bytes": lambda value: is_count(value) and value > 0,
    "sha256": lambda value: type(value) is str and _CHECKSUM.fullmatch(value) is not None,
    "smooth": lambda value: type(value) is float and 0 <= value <= 100,
    **dict.fromkeys(_LEVELS, _is_level),
    "sample": lambda value: type(value) is str,
}


def is_map_name(name: str) -> bool:
    """Return whether a file of this name can be a store's map; it has no folder in it."""
    return _FILE_NAME.fullmatch(name) is not None


def manifest_bytes(entries: Iterable[Entry], version: int = VERSION) -> bytes:
    """Return the manifest's one spelling for these entries."""
    rows = []
    for entry in sorted(entries, key=lambda entry: entry.key):
        values = dict(vars(entry), p=entry.p if math.isfinite(entry.p) else "inf")
        values = {name: value for name, value in values.items() if name not in _ABSENT or value != _ABSENT[name]}
        rows.append(json.dumps(values, sort_keys=True, allow_nan=False))
    body = '"entries": [\n' + ",\n".join(rows) + f'\n],\n"version": {version}'
    return f'{{"checksum": "{hashlib.sha256(body.encode()).hexdigest()}",\n{body}}}\n'.encode()


def read_manifest(folder: Path) -> List[Entry]:
    """Read the manifest of the store in a folder.

    Raises:
        LegsError: there is none, it cannot be read, or a newer version wrote it.
        DamagedStoreError: it is not what was written.
    """
    path = folder / MANIFEST
    try:
        data = read_regular(path, _LARGEST)
    except (FileNotFoundError, NotADirectoryError):
        what = f"is not a store of weight maps: it has no {MANIFEST} (legs precompute writes one)"
        raise LegsError(f"{folder} {what}") from None
    except OSError as error:
        raise LegsError(f"{path} cannot be read: {error.strerror}") from None
    try:
        document = json.loads(data.decode("utf-8"))
        if type(document["version"]) is int and document["version"] > VERSION:
            raise LegsError(
                f"{path} was written by a newer legs-loss (format {document['version']}, this one reads {VERSION}): "
                "update legs-loss, or precompute to another folder"
            )
        entries = [Entry(**dict(row, p=float(row["p"]))) for row in document["entries"]]
        wrong = [name for entry in entries for name, fits in _FIELDS.items() if not fits(getattr(entry, name))]
        wrong += [entry.view for entry in entries if len({getattr(entry, name) is None for name in _LEVELS}) > 1]
        intact = not wrong and manifest_bytes(entries, document["version"]) == data
    except LegsError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, OverflowError):
        intact = False
    if not intact:
        raise DamagedStoreError(f"{path} is damaged: delete that file, and run legs precompute again to make the maps")
    return entries
