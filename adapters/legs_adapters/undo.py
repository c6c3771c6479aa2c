"""Undo the patches of a checkout, from its journal."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import List, Optional, Tuple

from legs_adapters.checkout.replace import Changes, locked, read_file, replace_files
from legs_adapters.code.folders import first_of, walk
from legs_adapters.code.limits import Budget
from legs_adapters.code.sources import Source, check_root, read_source
from legs_adapters.journal import JOURNAL, Journal
from legs_adapters.restoring import restored, weighted_lines
from legs_adapters.terms.writing import PACKAGE
from legs_loss import LegsError

# What an undo changes, and the files that it leaves as they are, each with the reason.
_Undone = Tuple[Changes, List[Tuple[str, str]]]


def undo(path: str | os.PathLike[str], force: bool = False, look: bool = False) -> _Undone:
    """Undo every patch of a checkout; while a file of it is left weighted, its journal and its legs.toml stay.

    Args:
        path: the checkout.
        force: in files that were edited since, put the patch's own lines back and leave the edits.
        look: change nothing, and return what would be done.

    Returns:
        By path, the bytes before and after, None of a file that the patch had created; and the files left as they are,
        each with the reason.

    Raises:
        LegsError: nothing was patched; or a file was edited since, and not ``force``. Nothing is changed then.
    """
    root = check_root(path)
    with locked(root, f"legs-patch --undo {path}") as stop:
        journal = Journal.read(root)
        if journal.data is None:
            bare = [f"{name} is weighted: {why}" for name, why in unrecorded(root)]
            raise LegsError(f"{root}: nothing to undo: there is no {JOURNAL}", *bare)
        changes, kept = _undone(root, journal, force)
        if not look:
            left = {name: layers for name, layers in journal.files.items() if name in dict(kept)}
            is_open = any(name not in journal.created for name, _ in kept)
            rest = journal._replace(files=left).dump() if is_open else None
            replace_files(root, {**changes, JOURNAL: (journal.data, rest)}, stop)
    return changes, kept


def unrecorded(root: Path) -> List[Tuple[str, str]]:
    """Return the files with weighted calls that the journal does not have, and of each what to do."""
    found: List[Tuple[str, str]] = []
    recorded = Journal.read(root).files
    for name in walk(root):
        source = read_source(root, name) if name not in recorded else None
        lines = weighted_lines(source.data) if isinstance(source, Source) and PACKAGE in source.text else []
        if lines:
            where = _recorded_in(root / name)
            what = f"no journal names it; restore it from git or by hand: {first_of(lines, 20, '; ')}"
            found.append((name, what if where is None else f"the journal is in {where}: legs-patch --undo {where}"))
    return found


def _recorded_in(file: Path) -> Optional[Path]:
    """Return the folder around a file whose journal has it: a checkout around this one, or nested in it."""
    for folder in file.parents:
        with contextlib.suppress(LegsError):
            if file.relative_to(folder).as_posix() in Journal.read(folder).files:
                return folder
    return None


def _undone(root: Path, journal: Journal, force: bool) -> _Undone:
    changes: Changes = {}
    kept: List[Tuple[str, str]] = []
    edited: List[str] = []
    budget = Budget()
    for name, layers in journal.files.items():
        data = current = read_file(root, name)
        if data is None:
            why = f"put it back, undo, and move it again; only if it is gone for good delete {JOURNAL}"
            kept.append((name, f"the file is gone: {why}"))
            continue
        for layer in reversed(layers):
            if data == layer.patched:
                data = layer.original
            elif data not in (earlier.original for earlier in layers):  # else it is as before: git took it back
                edited.append(name)
                data, why = restored(name, layer, data, budget)
                if why:
                    data = current
                    kept.append((name, why))
                    break
        if data != current:
            changes[name] = (current, data)
    if edited and not force:
        raise LegsError(
            f"{', '.join(sorted(set(edited)))}: edited since it was patched; --undo --force restores the patched lines "
            "and keeps the edits"
        )
    kept += unrecorded(root)
    for name in journal.created if not kept else ():
        current = read_file(root, name)
        if current is not None and journal.is_as_written(name, current):
            changes[name] = (current, None)
        elif current is not None:
            kept.append((name, "it was edited since"))
    return changes, kept
