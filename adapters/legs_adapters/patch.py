"""Patching a checkout, and taking it back: what is to be written is worked out first, and written at the end."""

from __future__ import annotations

import contextlib
import os
import subprocess
from pathlib import Path
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

from legs_adapters.code.folders import walk, why_left_out
from legs_adapters.code.sources import Source, Unreadable, check_root, read_source
from legs_adapters.edit import Edit, apply_edits, rewrite
from legs_adapters.journal import JOURNAL, Journal, Layer, digest, replace_files, undo_edits
from legs_adapters.settings import SETTINGS_FILE
from legs_adapters.sites import find
from legs_adapters.terms.findings import Findings
from legs_loss import LegsError

__all__ = ["Plan", "Undone", "plan", "undo", "write"]


class Plan(NamedTuple):
    """What a patch would do.

    Attributes:
        root: the checkout.
        findings: what was found in it.
        edits: by path, the edits of each file.
        after: by path, the bytes that each file would have.
        settings: the text of legs.toml, where one is to be written.
    """

    root: Path
    findings: Findings
    edits: Dict[str, List[Edit]]
    after: Dict[str, bytes]
    settings: Optional[str] = None


class Undone(NamedTuple):
    """What an undo did: files restored, files removed, files left as they are with the reason."""

    restored: List[str]
    removed: List[str]
    kept: List[Tuple[str, str]]


def plan(
    path: str | os.PathLike[str],
    exclude: Sequence[str] = (),
    by_hand: Sequence[Tuple[str, int]] = (),
    settings: Optional[str] = None,
    in_place: bool = False,
) -> Plan:
    """Work out what a patch would do, and write nothing.

    Args:
        path: the checkout.
        exclude: globs of what is not to be looked at.
        by_hand: (relative path, line) of the sites; the others are not sites then.
        settings: the text of legs.toml.
        in_place: keep every line's number (for running in memory).

    Raises:
        LegsError: no such folder; a site named by hand is not there.
    """
    root = check_root(path)
    readable: List[Source] = []
    unreadable: List[Unreadable] = []
    for name in walk(root, exclude):
        source = read_source(root, name)
        if isinstance(source, Source):
            readable.append(source)
        else:
            unreadable.append(source)
    findings = find(readable, by_hand, _unread(root, exclude, unreadable))
    findings.unreadable[:0] = unreadable
    for name, line in by_hand:
        if not any(site.path == name and site.named_by(line) for site in findings.sites) and not any(
            left.path == name and left.line == line for left in findings.patched
        ):
            why = next((entry.reason for entry in findings.unreadable if entry.path == name), None)
            why = why_left_out(root, name, exclude) or why
            if why is not None:
                raise LegsError(f"{name}:{line}: {why}")
            raise LegsError(f"there is no L1 term at {name}:{line} that can be rewritten")
    edits: Dict[str, List[Edit]] = {}
    after: Dict[str, bytes] = {}
    for name in sorted({site.path for site in findings.sites} | {call.path for call in findings.kept}):
        source, module = findings.program.sources[name], findings.program.module(name)
        assert module is not None
        sites = [site for site in findings.sites if site.path == name]
        kept = [call for call in findings.kept if call.path == name]
        edits[name] = rewrite(source, module, sites, kept, in_place)
        after[name] = apply_edits(source.data, edits[name])
    return Plan(root, findings, edits, after, settings)


def _unread(root: Path, exclude: Sequence[str], unreadable: Sequence[Unreadable]) -> Dict[str, str]:
    """The text, by path, of what is excluded or no Python: the names in it may be of functions that are patched."""
    paths = {entry.path for entry in unreadable}
    if exclude:
        paths |= set(walk(root)) - set(walk(root, exclude))
    texts: Dict[str, str] = {}
    for path in sorted(paths):
        with contextlib.suppress(OSError):
            texts[path] = (root / path).read_text(encoding="utf-8", errors="replace")
    return texts


def write(plan: Plan, force: bool = False) -> List[str]:
    """Carry out a plan; return the paths that were written.

    Raises:
        LegsError: the git tree has changes that are not the patch's own, and not ``force``; or a file cannot be
            written. Nothing is written then.
    """
    root, journal = plan.root, Journal.read(plan.root)
    old_journal = journal.dump()
    changes: Dict[str, Tuple[Optional[bytes], Optional[bytes]]] = {}
    for path, data in plan.after.items():
        source = plan.findings.program.sources[path]
        journal.files.setdefault(path, []).append(
            Layer(source.data, tuple((e.start, e.end, e.after.decode("utf-8")) for e in plan.edits[path]), digest(data))
        )
        changes[path] = (source.data, data)
    settings = _settings_change(plan, journal)
    if settings is not None:
        changes[SETTINGS_FILE] = settings
    if not changes:
        return []
    if not force:
        dirty = _dirty(root, Journal.read(root))
        if dirty:
            shown = ", ".join(dirty[:5]) + (f" and {len(dirty) - 5} more" if len(dirty) > 5 else "")
            raise LegsError(f"the git tree has uncommitted changes ({shown}): commit them, or give --force")
    written = list(changes)
    # The journal goes first: whatever happens after it, --undo knows what to look for.
    current = (root / JOURNAL).read_bytes() if (root / JOURNAL).is_file() else None
    assert current is None or old_journal is not None
    replace_files(root, {JOURNAL: (current, journal.dump()), **changes})
    return written


def _settings_change(plan: Plan, journal: Journal) -> Optional[Tuple[Optional[bytes], Optional[bytes]]]:
    if plan.settings is None:
        return None
    data = plan.settings.encode("utf-8")
    path = plan.root / SETTINGS_FILE
    if path.is_symlink():
        raise LegsError(f"{SETTINGS_FILE} is a link: legs-patch follows none")
    current = path.read_bytes() if path.is_file() else None
    if current == data:
        return None
    if current is not None and not journal.wrote(SETTINGS_FILE, current):
        raise LegsError(f"{SETTINGS_FILE} is there already, and not as legs-patch wrote it: change the settings in it")
    journal.created[SETTINGS_FILE] = digest(data)
    return current, data


def undo(path: str | os.PathLike[str], force: bool = False) -> Undone:
    """Take every patch of a checkout back.

    Raises:
        LegsError: nothing was patched; or a file was edited since, and not ``force``. Nothing is changed then.
    """
    root = check_root(path)
    journal = Journal.read(root)
    if not journal.files and not journal.created:
        raise LegsError(f"{root}: there is nothing to take back: no {JOURNAL}")
    changes: Dict[str, Tuple[Optional[bytes], Optional[bytes]]] = {}
    done = Undone([], [], [])
    edited: List[str] = []
    for name, layers in journal.files.items():
        full = root / name
        current = full.read_bytes() if full.is_file() else None
        if current is None:
            done.kept.append((name, "it is gone"))
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
                data, missing = undo_edits(layer.original, layer.patched(), data)
                lost.extend(missing)
        if lost:
            done.kept.append((name, "these lines were changed since and stay: " + "; ".join(sorted(set(lost)))))
        if data != current:
            changes[name] = (current, data)
            done.restored.append(name)
    if edited and not force:
        raise LegsError(
            f"{', '.join(sorted(set(edited)))}: edited since it was patched; --undo --force puts the patch's own lines "
            "back and leaves the edits"
        )
    for name, wrote in journal.created.items():
        full = root / name
        current = full.read_bytes() if full.is_file() and not full.is_symlink() else None
        if current is None:
            continue
        if digest(current) == wrote:
            changes[name] = (current, None)
            done.removed.append(name)
        else:
            done.kept.append((name, "it was edited since: yours now"))
    changes[JOURNAL] = ((root / JOURNAL).read_bytes(), None)
    replace_files(root, changes)
    return done


def _dirty(root: Path, journal: Journal) -> List[str]:
    """Return the tracked files with uncommitted changes that no patch of ours made; empty outside of git."""
    command = ["git", "-c", "core.fsmonitor=", "-c", "core.quotepath=off", "-C", str(root), "status", "--porcelain",
               "-z", "--untracked-files=no", "--ignore-submodules=all", "--no-renames", "--", "."]  # fmt: skip
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=60)
        top = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "--show-prefix"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
    except (OSError, subprocess.TimeoutExpired):
        return []
    if done.returncode != 0 or top.returncode != 0:
        return []
    prefix = top.stdout.decode("utf-8", "replace").strip()
    dirty = []
    for entry in done.stdout.decode("utf-8", "replace").split("\0"):
        if len(entry) > 3:
            name = entry[3:]
            name = name[len(prefix) :] if name.startswith(prefix) else name
            full = root / name
            if not (full.is_file() and journal.wrote(name, full.read_bytes())):
                dirty.append(name)
    return dirty
