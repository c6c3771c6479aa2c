"""One map as a file: an .npy of float16, checked when it is read."""

from __future__ import annotations

import hashlib
import os
import re
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from legs_loss.store.manifest import DamagedStoreError, Entry
from legs_loss.system.files import read_regular

_PIECE = 1 << 20  # bytes; for larger ones Linux may look for larger free pages, which took six times as long
_REPAIR = "run legs precompute again to repair it"


def read_map(folder: Path, entry: Entry) -> np.ndarray:
    """Return the map E^ of an entry of the store in ``folder``: :meth:`WeightStore.normalised_response`."""
    path, head, shape = folder / entry.file, _head(entry), (entry.height, entry.width)
    size = len(head) + 2 * entry.height * entry.width
    try:
        data = read_regular(path, size)
    except OSError as error:
        raise DamagedStoreError(f"{path} cannot be read ({error.strerror}); {_REPAIR}") from None
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise DamagedStoreError(f"{path} is damaged: its checksum differs; {_REPAIR}")
    if not data.startswith(head) or len(data) != size:
        raise DamagedStoreError(f"{path} holds no float16 array of {list(shape)}; {_REPAIR}")
    values = np.frombuffer(data, np.float16, offset=len(head)).reshape(shape).copy()
    # Bits of float16 are in the order of the numbers from 0 to 1; those of all others, NaN too, are larger.
    if values.view(np.uint16).max() > np.float16(1).view(np.uint16):
        raise DamagedStoreError(f"{path} has values that are not in [0, 1]; {_REPAIR}")
    return values


def _head(entry: Entry) -> bytes:
    """Return what an .npy of an entry's size begins with, as numpy writes it: no other is read, so none is parsed."""
    text = f"{{'descr': '<f2', 'fortran_order': False, 'shape': ({entry.height}, {entry.width}), }}"
    return b"\x93NUMPY\x01\x00v\x00" + text.ljust(117).encode() + b"\n"


def is_intact(folder: Path, entry: Entry) -> bool:
    """Return whether an entry's map can be read and is the one that was written."""
    with suppress(DamagedStoreError):
        read_map(folder, entry)
        return True
    return False


def stage(staging: Path, entry: Entry, normalised: np.ndarray) -> Entry:
    """Write a map to a writer's staging folder and return its entry with file, bytes and checksum filled in.

    Args:
        staging: ``StoreWriter.staging``.
        entry: without ``file``, ``bytes`` and ``sha256``.
        normalised: E^ in [0, 1], [H, W].
    """
    data = _head(entry) + np.ascontiguousarray(normalised, "<f2").tobytes()
    sha256 = hashlib.sha256(data).hexdigest()
    # The name is for people; the digest, of the key and the content, keeps every two maps apart.
    readable = re.sub(r"[^0-9a-z]+", "_", os.path.splitext(entry.view)[0].lower()).strip("_")[-40:] or "view"
    digest = hashlib.sha256(f"{sha256}{entry.key}".encode()).hexdigest()[:16]
    file = f"{readable}-{digest}.npy"
    write_parts(staging / file, data)
    return replace(entry, file=file, bytes=len(data), sha256=sha256)


def write_parts(path: Path, data: bytes) -> None:
    """Write a file in pieces."""
    with open(str(path), "wb") as file:
        for start in range(0, len(data), _PIECE):
            file.write(data[start : start + _PIECE])
