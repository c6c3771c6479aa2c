"""Find and remove the leftovers of killed writers in a store."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Iterable, List

from legs_loss.store.manifest import Entry, is_map_name
from legs_loss.system.locks import is_held

STAGING = ".writing-"  # begins the name of a writer's folder
LOCK = ".lock"  # in the store, held over each change; in a staging folder, held while its writer lives


def leftovers(folder: Path, entries: Iterable[Entry]) -> List[Path]:
    """Return the leftovers of killed writers in a store: maps without an entry, and unlocked staging folders."""
    listed = {entry.file for entry in entries}
    return [
        path
        for path in folder.iterdir()
        if (is_map_name(path.name) and path.name not in listed)
        or (path.name.startswith(STAGING) and (path.is_symlink() or not is_held(path / LOCK)))
    ]


def remove(path: Path) -> None:
    """Delete a file or a folder; of a link, the link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(str(path), ignore_errors=True)
    elif os.path.lexists(str(path)):
        path.unlink()
