"""Undo the patches of a checkout, from its journal."""

from __future__ import annotations

import os
from pathlib import Path
from typing import List, Optional, Sequence, Tuple

from legs_adapters.checkout.comparing import compared
from legs_adapters.checkout.replace import Changes, locked, read_file, replace_files
from legs_adapters.code.folders import first_of
from legs_adapters.code.limits import Budget
from legs_adapters.code.sources import check_root
from legs_adapters.edit import apply_edits
from legs_adapters.journal import JOURNAL, Journal, Layer, digest
from legs_loss import LegsError

__all__ = ["undo"]

# What an undo changes, and the files that it leaves as they are, each with the reason.
_Undone = Tuple[Changes, List[Tuple[str, str]]]


def undo(path: str | os.PathLike[str], force: bool = False, trust: Optional[str] = None, look: bool = False) -> _Undone:
    """Undo every patch of a checkout.

    Args:
        path: the checkout.
        force: in files that were edited since, put the patch's own lines back and leave the edits.
        trust: the name of a journal that this user did not write, to accept it.
        look: change nothing, and return what would be done; any journal is accepted then.

    Returns:
        By path, the bytes before and after, None of a file that the patch had created; and the files left as they are,
        each with the reason.

    Raises:
        LegsError: nothing was patched; another user wrote the journal; or a file was edited since, and not ``force``.
            Nothing is changed then.
    """
    root = check_root(path)
    with locked(root, f"legs-patch --undo {path}"):
        journal = Journal.read(root)
        if journal.data is None:
            raise LegsError(f"{root}: nothing to undo: there is no {JOURNAL}")
        if not (journal.is_own or look or trust == journal.name):
            covered = first_of([*journal.files, *journal.created], 3)
            raise LegsError(
                f"{root / JOURNAL} was not written by your legs-patch on this machine (or by a version without seals, "
                f"or its key is gone): nothing was changed. It covers {covered}, which git can restore. To use it "
                f"anyway, check its changes with `legs-patch --undo --diff {path}`, then run "
                f"`legs-patch --undo --trust {journal.name} {path}`"
            )
        changes, kept = _undone(root, journal, force)
        if not look:
            replace_files(root, {**changes, JOURNAL: (journal.data, None)})
    return changes, kept


def _undone(root: Path, journal: Journal, force: bool) -> _Undone:
    changes: Changes = {}
    kept: List[Tuple[str, str]] = []
    edited: List[str] = []
    budget = Budget()
    for name, layers in journal.files.items():
        data = current = read_file(root, name)
        if data is None:
            kept.append((name, "the file is gone"))
            continue
        for layer in reversed(layers):
            if digest(data) == layer.after:
                data = layer.original
            elif data not in (earlier.original for earlier in layers):  # else it is as before: git took it back
                edited.append(name)
                data, lost = _undo_edits(name, layer, data, budget)
                if lost:
                    data = current
                    shown = first_of([line[:200] for line in sorted(set(lost))], 20, "; ")
                    kept.append((name, f"these lines were edited since and are kept, with the others: {shown}"))
                    break
        if data != current:
            changes[name] = (current, data)
    if edited and not force:
        raise LegsError(
            f"{', '.join(sorted(set(edited)))}: edited since it was patched; --undo --force restores the patched lines "
            "and keeps the edits"
        )
    for name in journal.created:
        current = read_file(root, name)
        if current is not None and journal.is_as_written(name, current):
            changes[name] = (current, None)
        elif current is not None:
            kept.append((name, "it was edited since"))
    return changes, kept


def _undo_edits(name: str, layer: Layer, current: bytes, budget: Budget) -> Tuple[bytes, List[str]]:
    """Restore the patched lines of a file that was edited since, all of them or none.

    Returns:
        The file with the patch's lines as they were and the edits as they are; and the patched lines that are no longer
        there as the patch left them: then the file is as it was.
    """
    patched = apply_edits(layer.original, layer.edits)
    before, after, lines = (data.splitlines(keepends=True) for data in (layer.original, patched, current))
    parts = [part[1:] for part in compared(before, after) if part[0] != "equal"]
    over = budget.spend(name, len(parts) * (len(after) + len(lines))) or budget.why_none_left()
    restored: List[bytes] = []
    lost: List[str] = []
    at = 0
    for start, end, first, last in parts:
        place = -1 if over else _place(after, first, last, lines)
        if place < at:  # it is gone, or in another order
            lost += [line.decode("utf-8", "replace").strip() for line in after[first:last]]
        else:
            restored += [*lines[at:place], *before[start:end]]
            at = place + last - first
    return (current, lost) if lost else (b"".join([*restored, *lines[at:]]), lost)


def _place(after: Sequence[bytes], first: int, last: int, lines: Sequence[bytes]) -> int:
    """Return where lines that were patched are now; -1 where they are not as often as the patch left them."""
    part = after[first:last]
    here, there = ([at for at in range(len(text)) if text[at : at + len(part)] == part] for text in (after, lines))
    return there[here.index(first)] if part and len(here) == len(there) else -1
