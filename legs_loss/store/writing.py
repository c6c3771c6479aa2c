"""Write maps to a store, safe against kills at any moment and against concurrent writers."""

from __future__ import annotations

import os
import tempfile
from contextlib import contextmanager
from pathlib import Path
from typing import Iterator, List, Sequence, Union

from legs_loss.errors import LegsError
from legs_loss.store.leftovers import LOCK, STAGING, leftovers, remove
from legs_loss.store.manifest import MANIFEST, Entry, manifest_bytes, read_manifest
from legs_loss.store.maps import write_parts
from legs_loss.system.locks import FileLock


class StoreWriter:
    """Write to a store, concurrently with other writers; a context manager.

    A map is staged (from any process) and moved into the store by :meth:`commit`. A killed writer loses only what it
    had not committed.

    Args:
        path: the folder, made if it is missing.

    Raises:
        LegsError: the folder cannot be written, or a newer version wrote it.
        DamagedStoreError: its manifest is damaged.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from legs_loss import WeightSpec
        >>> from legs_loss.store import WeightStore, stage
        >>> folder = tempfile.mkdtemp()
        >>> with StoreWriter(folder) as writer:
        ...     made = Entry("images/1.png", 4, 3, "laplacian", 2.0, 1e-8, None, "", 0, 0)
        ...     writer.commit([stage(writer.staging, made, np.zeros((3, 4), np.float16))])
        >>> WeightStore(folder).find("1", 3, 4, WeightSpec()).view
        'images/1.png'
    """

    def __init__(self, path: Union[str, Path]) -> None:
        self.path: Path = Path(path)
        self._is_new: bool = not os.path.lexists(str(path))

    def __enter__(self) -> StoreWriter:
        with self._locked():
            for leftover in leftovers(self.path, self.entries()):
                remove(leftover)
            self.staging: Path = Path(tempfile.mkdtemp(prefix=STAGING, dir=str(self.path)))
            self._alive = FileLock(self.staging / LOCK)
        return self

    def __exit__(self, *_: object) -> None:
        self._alive.release()
        remove(self.staging)
        if self._is_new and os.listdir(str(self.path)) == [LOCK]:  # nothing came of it
            remove(self.path)

    def commit(self, staged: Sequence[Entry], dropped: Sequence[Entry] = ()) -> None:
        """Move staged maps into the store and list them, in place of ``dropped`` and of those with the same key."""
        with self._locked():
            entries = {entry.key: entry for entry in self.entries()}
            before = {entry.file for entry in entries.values()}
            for entry in dropped:
                entries.pop(entry.key, None)
            entries.update((entry.key, entry) for entry in staged)
            write_parts(self.staging / MANIFEST, manifest_bytes(entries.values()))
            for file in [*(entry.file for entry in staged), MANIFEST]:
                _sync(self.staging / file)  # here, not at the write: only the commit waits for the disk
                os.replace(str(self.staging / file), str(self.path / file))
            if os.name == "posix":  # elsewhere a folder cannot be opened
                _sync(self.path)
            for file in before - {entry.file for entry in entries.values()}:
                remove(self.path / file)

    def entries(self) -> List[Entry]:
        """Return what the store lists now."""
        return read_manifest(self.path) if os.path.lexists(str(self.path / MANIFEST)) else []

    @contextmanager
    def _locked(self) -> Iterator[None]:
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with FileLock(self.path / LOCK):
                yield
        except OSError as error:
            raise LegsError(f"cannot write to {self.path}: {error.strerror or error}") from None


def _sync(path: Path) -> None:
    """Wait until a file, or which files a folder has, is on the disk."""
    descriptor = os.open(str(path), os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
