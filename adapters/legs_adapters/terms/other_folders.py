"""Find skipped folders that mention an L1: the user may have meant one of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Dict, List, Sequence

from legs_adapters.code.folders import PATCHABLE, TESTS, VENDORED, Skipped, folders_of
from legs_adapters.code.limits import MAX_FILE_BYTES
from legs_loss.system import read_regular

__all__ = ["not_entered"]

_L1 = re.compile(rb"l1_?loss", re.I)
_TRAINS = re.compile(rb"\.backward\(")


def not_entered(root: Path, exclude: Sequence[str] = ()) -> List[Skipped]:
    """Return the skipped folders whose Python mentions an L1; those with a backward pass first."""
    found: Dict[Skipped, bool] = {}
    for _, folders in folders_of(root, exclude):
        for folder in folders:
            _mentions(root, folder, found)
    return sorted(found, key=lambda folder: (not found[folder], folder))


def _mentions(root: Path, skipped: Skipped, found: Dict[Skipped, bool]) -> None:
    """Record whether a folder mentions an L1 and trains; the folders in third_party are recorded one by one."""
    if skipped.why not in PATCHABLE:
        return
    for files, folders in folders_of(root / skipped.path, ()):
        for file in files:
            try:
                data = read_regular(root / skipped.path / file, MAX_FILE_BYTES)
            except OSError:
                continue
            if _L1.search(data):
                inner, slash, _ = file.partition("/")
                vendored = slash and skipped.why == VENDORED
                folder = Skipped(f"{skipped.path}/{inner}", VENDORED) if vendored else skipped
                found[folder] = found.get(folder, False) or _TRAINS.search(data) is not None
        for folder in folders:
            if folder.why != TESTS:
                _mentions(root, Skipped(f"{skipped.path}/{folder.path}", folder.why), found)
