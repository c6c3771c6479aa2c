"""Weight maps on disk, or rather what every curve and beta can be made from: normalised responses.

A store is a folder: ``manifest.json`` and one ``.npy`` a view, size and operator, float16 [H, W]. A map of 1 is exact;
elsewhere float16 rounds E^ by at most 2^-12, and small values by at most 1 part in 2048.

Readers open the manifest and nothing else; it is replaced as a whole, so they need no lock. Writers stage maps in a
folder of their own and move them in, with the manifest, under a lock: whatever the manifest does not list is a leftover
of a writer that was killed, and the next writer sweeps it.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import shutil
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.files import read_regular
from legs_loss.locks import FileLock, is_held
from legs_loss.manifest import MANIFEST, DamagedStoreError, Entry, is_map_name, manifest_bytes, read_manifest
from legs_loss.scenes.model import view_names
from legs_loss.spec import WeightSpec

__all__ = ["DamagedStoreError", "Entry", "StoreWriter", "WeightStore", "fingerprint", "is_intact", "read_map", "stage"]

_STAGING = ".writing-"
_LOCK = ".lock"
_PIECE = 1 << 20  # bytes; for larger ones Linux may look for larger free pages, which took six times as long
_REPAIR = "run legs precompute again to repair it"


class Damage(NamedTuple):
    """What is wrong with a store: entries whose map is damaged or missing, and files that belong to no entry."""

    damaged: List[Entry]
    orphans: List[str]


class WeightStore:
    """A store, opened for reading: only its manifest is read.

    Args:
        path: the folder.

    Raises:
        LegsError: there is no store, or a newer version wrote it.
        DamagedStoreError: its manifest is damaged.
    """

    def __init__(self, path: Union[str, Path]) -> None:
        self.path: Path = Path(path)
        if not os.path.lexists(str(self.path / MANIFEST)):
            raise LegsError(
                f"{self.path} is no store of weight maps: it has no {MANIFEST} (legs precompute writes one)"
            )
        self.entries: Dict[Tuple[Any, ...], Entry] = {entry.key: entry for entry in read_manifest(self.path)}
        self._by_name: Dict[Tuple[Any, ...], Optional[Entry]] = {}
        self._by_image: Dict[Tuple[Any, ...], Entry] = {}
        for entry in self.entries.values():
            image = (entry.fingerprint, *entry.key[1:])
            self._by_image[image] = entry
            for name in view_names(entry.view):
                key = (name, *entry.key[1:])
                self._by_name[key] = None if key in self._by_name else entry

    def find(self, view: str, height: int, width: int, spec: WeightSpec) -> Optional[Entry]:
        """Return the entry of a view at a size for a spec's operator, or None.

        Args:
            view: the photograph's path in the scene or the last parts of it, with or without the extension, or up to
                the first dot as 3DGS names views. A name that fits two stored views gets None: it is never guessed.
            height: of the training image in pixels.
            width: likewise.
            spec: its operator, p and eps count.
        """
        name = view.replace("\\", "/")
        return self._by_name.get((name, height, width, spec.operator, spec.p, spec.eps))

    def find_image(self, fingerprint: str, height: int, width: int, spec: WeightSpec) -> Optional[Entry]:
        """Return the entry that was made from an image with a fingerprint, whatever its view is called, or None."""
        return self._by_image.get((fingerprint, height, width, spec.operator, spec.p, spec.eps))

    def normalised_response(self, entry: Entry) -> np.ndarray:
        """Return an entry's map E^, float16 [H, W], after checking its checksum.

        Raises:
            DamagedStoreError: the file is missing or is not the one that was written.
        """
        return read_map(self.path, entry)

    def check(self) -> Damage:
        """Read every map and compare checksums."""
        entries = self.entries.values()
        damaged = [entry for entry in entries if not is_intact(self.path, entry)]
        return Damage(damaged, sorted(path.name for path in _leftovers(self.path, entries)))


class StoreWriter:
    """Writes to a store, beside other writers; a context manager.

    A map is staged (from any process) and takes its place with :meth:`commit`. A writer that is killed loses what it
    had not committed and nothing else.

    Args:
        path: the folder, made if it is missing.

    Raises:
        LegsError: the folder cannot be written, or a newer version wrote it.
        DamagedStoreError: its manifest is damaged.

    Example:
        >>> folder = tempfile.mkdtemp()
        >>> with StoreWriter(folder) as writer:
        ...     made = Entry("images/1.png", 4, 3, "laplacian", 2.0, 1e-8, None, "", 0, 0)
        ...     writer.commit([stage(writer.staging, made, np.zeros((3, 4), np.float16))])
        >>> WeightStore(folder).find("1", 3, 4, WeightSpec()).file
        'images_1-f5049e0ccc83ca46.npy'
    """

    def __init__(self, path: Union[str, Path]) -> None:
        self.path: Path = Path(path)

    def __enter__(self) -> StoreWriter:
        with self._locked():
            for leftover in _leftovers(self.path, self.entries()):
                _remove(leftover)
            self.staging: Path = Path(tempfile.mkdtemp(prefix=_STAGING, dir=str(self.path)))
            self._alive = FileLock(self.staging / _LOCK)
        return self

    def __exit__(self, *_: object) -> None:
        self._alive.release()
        _remove(self.staging)

    def commit(self, staged: Sequence[Entry]) -> None:
        """Move staged maps into the store and list them, in place of older ones with the same key."""
        with self._locked():
            entries = {entry.key: entry for entry in self.entries()}
            before = {entry.file for entry in entries.values()}
            for entry in staged:
                # Here, not where it was written: nobody waits for the disk but who commits.
                _sync(self.staging / entry.file)
                os.replace(str(self.staging / entry.file), str(self.path / entry.file))
                entries[entry.key] = entry
            _write(self.staging / MANIFEST, manifest_bytes(entries.values()))
            _sync(self.staging / MANIFEST)
            os.replace(str(self.staging / MANIFEST), str(self.path / MANIFEST))
            if os.name == "posix":  # elsewhere a folder cannot be opened
                _sync(self.path)
            for file in before - {entry.file for entry in entries.values()}:
                _remove(self.path / file)

    def entries(self) -> List[Entry]:
        """Return what the store lists now."""
        return read_manifest(self.path) if os.path.lexists(str(self.path / MANIFEST)) else []

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.path / _LOCK)
            try:
                yield
            finally:
                lock.release()
        except OSError as error:
            raise LegsError(f"cannot write to {self.path}: {error.strerror or error}") from None


def read_map(folder: Path, entry: Entry) -> np.ndarray:
    """Return the map E^ of an entry of the store in ``folder``: :meth:`WeightStore.normalised_response`."""
    path = folder / entry.file
    try:
        data = read_regular(path, entry.bytes)
    except OSError as error:
        raise DamagedStoreError(f"{path} cannot be read ({error.strerror}); {_REPAIR}") from None
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise DamagedStoreError(f"{path} is damaged: its checksum differs; {_REPAIR}")
    return _checked_map(path, data, entry)


def _checked_map(path: Path, data: bytes, entry: Entry) -> np.ndarray:
    """The array of an .npy file, which a stranger may have written, if it can be a normalised response."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        shape, by_columns, kind = np.lib.format.read_array_header_1_0(file)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise DamagedStoreError(f"{path} holds no plain array ({error}); {_REPAIR}") from None
    body = data[file.tell() :]
    wanted = (entry.height, entry.width)
    if (version, by_columns, kind) != ((1, 0), False, np.float16) or len(body) != 2 * entry.height * entry.width:
        raise DamagedStoreError(f"{path} holds no float16 array of {list(wanted)}; {_REPAIR}")
    if tuple(shape) != wanted:
        raise DamagedStoreError(f"{path} has the shape {list(shape)}, its entry says {list(wanted)}; {_REPAIR}")
    values = np.frombuffer(bytearray(body), np.float16).reshape(wanted)
    # Bits of float16 are in the order of the numbers from 0 to 1; those of all others, NaN too, are larger.
    if values.view(np.uint16).max() > np.float16(1).view(np.uint16):
        raise DamagedStoreError(f"{path} has values that are not in [0, 1]; {_REPAIR}")
    return values


def is_intact(folder: Path, entry: Entry) -> bool:
    """Return whether an entry's map can be read and is the one that was written."""
    try:
        read_map(folder, entry)
    except DamagedStoreError:
        return False
    return True


def stage(staging: Path, entry: Entry, normalised: np.ndarray) -> Entry:
    """Write a map to a writer's staging folder and return its entry with file, bytes and checksum filled in.

    Args:
        staging: ``StoreWriter.staging``.
        entry: without ``file``, ``bytes`` and ``sha256``.
        normalised: E^ in [0, 1], [H, W].
    """
    parts = _npy(np.ascontiguousarray(normalised, np.float16))
    checksum = hashlib.sha256()
    for part in parts:
        checksum.update(part)
    sha256 = checksum.hexdigest()
    # The name is for people; the digest, of the key and the content, keeps every two maps apart.
    readable = re.sub(r"[^0-9a-z]+", "_", os.path.splitext(entry.view)[0].lower()).strip("_")[-40:] or "view"
    digest = hashlib.sha256(f"{sha256}{entry.key}".encode()).hexdigest()[:16]
    file = f"{readable}-{digest}.npy"
    _write(staging / file, *parts)
    return replace(entry, file=file, bytes=sum(len(part) for part in parts), sha256=sha256)


def fingerprint(image: Union[Tensor, np.ndarray]) -> str:
    """Return a short name of an image's values: two images have the same one only where they have the same map.

    Values that are whole 255ths, as those of 8-bit photographs are, count as such however they were divided; values
    that are whole 65535ths likewise; an image with any other value has a name by its float32 values, to the last bit.

    Args:
        image: floats in [0, 1], [C, H, W], on any device; or uint8 or uint16 [H, W, C].

    Example:
        >>> pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
        >>> fingerprint(pixels) == fingerprint(torch.from_numpy(pixels).permute(2, 0, 1) / 255.0)
        True
    """
    if isinstance(image, np.ndarray) and image.dtype in (np.uint8, np.uint16):
        values = image
    else:
        tensor = torch.as_tensor(image).detach()
        values = _whole_numbers(tensor.float().permute(1, 2, 0).cpu().numpy(), tensor.dtype == torch.float16)
    if values.dtype == np.uint16 and not (values % 257).any():
        values = (values // 257).astype(np.uint8)  # an 8-bit photograph in 16 bits
    kind = "" if values.dtype == np.uint8 else values.dtype.name
    digest = hashlib.sha256(f"{values.shape!r}{kind}".encode())
    digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()[:32]


def _whole_numbers(image: np.ndarray, halves: bool) -> np.ndarray:
    """Return an image's values as the 8- or 16-bit numbers that they are fractions of; else as they are."""
    # float32 rounds values up to 1 by 6e-8, float16 by 2^-12.
    for kind, tolerance in ((np.uint8, 255 / 4096 if halves else 1e-4), (np.uint16, 2e-2)):
        scaled = image * np.float32(np.iinfo(kind).max)
        whole = np.rint(scaled)
        with np.errstate(invalid="ignore"):  # of an infinity
            near = np.abs(scaled - whole).max() <= tolerance
        if near and whole.min() >= 0 and whole.max() <= np.iinfo(kind).max:
            return whole.astype(kind)
    return image


def _leftovers(folder: Path, entries: Iterable[Entry]) -> List[Path]:
    """What killed writers left in a store: maps of no entry, and staging folders that no one holds."""
    listed = {entry.file for entry in entries}
    return [
        path
        for path in folder.iterdir()
        if (is_map_name(path.name) and path.name not in listed)
        or (path.name.startswith(_STAGING) and (path.is_symlink() or not is_held(path / _LOCK)))
    ]


def _npy(array: np.ndarray) -> Tuple[bytes, memoryview]:
    """An .npy file in two parts, its head and the array's own memory: numpy.save to a buffer would copy that."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
    return head.getvalue(), array.reshape(-1).view(np.uint8).data


def _write(path: Path, *parts: Union[bytes, memoryview]) -> None:
    with open(str(path), "wb") as file:
        for part in parts:
            for start in range(0, len(part), _PIECE):
                file.write(part[start : start + _PIECE])


def _sync(path: Path) -> None:
    """Wait until a file, or which files a folder has, is on the disk."""
    descriptor = os.open(str(path), os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove(path: Path) -> None:
    """Delete a file or a folder; of a link, the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(str(path), ignore_errors=True)
    elif os.path.lexists(str(path)):
        path.unlink()
