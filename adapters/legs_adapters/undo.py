"""Undo the patches of a checkout, from its journal."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

from legs_adapters.checkout.comparing import Effort, matching_lines
from legs_adapters.checkout.replace import Changes, locked, read_file, replace_files
from legs_adapters.code.sources import check_root
from legs_adapters.journal import JOURNAL, Journal, digest
from legs_loss import LegsError

__all__ = ["Undone", "undo", "undo_edits"]


class Undone(NamedTuple):
    """The changes that an undo made, or would make.

    Attributes:
        restored: the files that are as before the patch.
        removed: the files that the patch had created.
        kept: the files left as they are, with the reason.
        changes: by path, the bytes before and after.
    """

    restored: List[str]
    removed: List[str]
    kept: List[Tuple[str, str]]
    changes: Changes


def undo(path: str | os.PathLike[str], force: bool = False, trust: Optional[str] = None, look: bool = False) -> Undone:
    """Undo every patch of a checkout.

    Args:
        path: the checkout.
        force: in files that were edited since, put the patch's own lines back and leave the edits.
        trust: the name of a journal that this user did not write, to accept it.
        look: change nothing, and return what would be done; any journal is accepted then.

    Raises:
        LegsError: nothing was patched; another user wrote the journal; or a file was edited since, and not ``force``.
            Nothing is changed then.
    """
    root = check_root(path)
    with locked(root, f"legs-patch --undo {path}"):
        journal = Journal.read(root)
        if journal.data is None:
            raise LegsError(f"{root}: nothing to undo: there is no {JOURNAL}")
        if not (journal.ours or look or trust == journal.name):
            raise LegsError(_not_ours(root, journal, path))
        done = _work_out(root, journal, force)
        if not look:
            replace_files(root, {**done.changes, JOURNAL: (journal.data, None)})
    return done


def _work_out(root: Path, journal: Journal, force: bool) -> Undone:
    changes: Dict[str, Tuple[Optional[bytes], Optional[bytes]]] = {}
    done = Undone([], [], [], changes)
    edited: List[str] = []
    effort = Effort()
    for name, layers in journal.files.items():
        current = read_file(root, name)
        if current is None:
            done.kept.append((name, "the file is gone"))
            continue
        data = current
        lost: List[str] = []
        for layer in reversed(layers):
            if digest(data) == layer.after:
                data = layer.original
            elif data != layer.original:  # as before already: the write was interrupted, or git took it back
                if digest(data) in (digest(earlier.original) for earlier in layers):
                    continue
                edited.append(name)
                data, missing = undo_edits(layer.original, layer.patched(), data, effort)
                lost.extend(missing)
        if lost:
            shown = sorted(set(lost))
            more = f" and {len(shown) - 20} more" if len(shown) > 20 else ""
            listed = "; ".join(line[:200] for line in shown[:20])
            done.kept.append((name, f"these lines were edited since and are kept: {listed}{more}"))
        if data != current:
            changes[name] = (current, data)
            done.restored.append(name)
    if edited and not force:
        raise LegsError(
            f"{', '.join(sorted(set(edited)))}: edited since it was patched; --undo --force restores the patched lines "
            "and keeps the edits"
        )
    for name, wrote in journal.created.items():
        current = read_file(root, name)
        if current is None:
            continue
        if digest(current) == wrote:
            changes[name] = (current, None)
            done.removed.append(name)
        else:
            done.kept.append((name, "it was edited since"))
    return done


def _not_ours(root: Path, journal: Journal, path: object) -> str:
    names = [*journal.files, *journal.created]
    shown = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return (
        f"{root / JOURNAL} was not written by your legs-patch on this machine (or by a version without seals, or its "
        f"key is gone): nothing was changed. It covers {shown}, which git can restore. To use it anyway, check its "
        f"changes with `legs-patch --undo --diff {path}`, then run `legs-patch --undo --trust {journal.name} {path}`"
    )


def undo_edits(
    original: bytes, patched: bytes, current: bytes, effort: Optional[Effort] = None
) -> Tuple[bytes, List[str]]:
    """Restore the patched lines of a file that was edited since.

    Args:
        original, patched: the file before and after the patch.
        current: the file as it stands.
        effort: what comparing it may take, with the other files.

    Returns:
        The file with the patch's lines as they were and the edits as they are; and the patched lines that are no
        longer there as the patch left them, which were left alone.
    """
    before, after, lines = (data.splitlines(keepends=True) for data in (original, patched, current))
    effort = effort or Effort()
    lost: List[str] = []
    where = {a + i: b + i for a, b, size in matching_lines(after, lines, effort) for i in range(size)}
    changes: List[Tuple[int, int, Sequence[bytes]]] = []
    ended = 0, 0
    for i2, j2, size in [*matching_lines(before, after, effort), (len(before), len(after), 0)]:
        (i1, j1), ended = ended, (i2 + size, j2 + size)
        if (i1, j1) == (i2, j2):
            continue
        places = [where[j] for j in range(j1, j2) if j in where]
        if j1 == j2 or len(places) < j2 - j1 or places[-1] - places[0] >= j2 - j1:
            lost.extend(line.decode("utf-8", "replace").strip() for line in after[j1:j2])
        else:
            changes.append((places[0], places[-1] + 1, before[i1:i2]))
    for start, end, put in reversed(changes):
        lines[start:end] = put
    return b"".join(lines), lost
