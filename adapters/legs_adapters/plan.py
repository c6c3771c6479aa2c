"""Plan a patch of a checkout, and write it: everything is computed before anything is written."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

from legs_adapters.checkout.git import changed_files
from legs_adapters.checkout.replace import locked, read_file, replace_files
from legs_adapters.code.folders import why_left_out
from legs_adapters.code.sources import Unreadable, check_root, read_files
from legs_adapters.edit import Edit, apply_edits, rewrite
from legs_adapters.journal import JOURNAL, Journal, Layer, digest
from legs_adapters.rules.find import find
from legs_adapters.settings import SETTINGS_FILE
from legs_adapters.terms.findings import Findings
from legs_loss import LegsError

__all__ = ["Plan", "plan", "write"]


class Plan(NamedTuple):
    """A patch that was computed and not yet written.

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


@contextlib.contextmanager
def _deep_recursion() -> Iterator[None]:
    """Raise the recursion limit for expressions of some thousand parts; report longer ones as a LegsError."""
    before = sys.getrecursionlimit()
    # Before Python 3.11 a Python call takes some of the process's stack.
    sys.setrecursionlimit(max(before, 20_000 if sys.version_info >= (3, 11) else 6_000))
    try:
        yield
    except RecursionError:
        raise LegsError(
            "an expression of thousands of parts is nested too deeply: skip its file with --exclude"
        ) from None
    finally:
        sys.setrecursionlimit(before)


def plan(
    path: str | os.PathLike[str],
    exclude: Sequence[str] = (),
    by_hand: Sequence[Tuple[str, int]] = (),
    in_place: bool = False,
    ssim: bool = False,
    masks: bool = False,
) -> Plan:
    """Compute a patch, and write nothing.

    Args:
        path: the checkout.
        exclude: globs of files and folders to ignore.
        by_hand: (relative path, line) of the sites; the others are not sites then.
        in_place: keep every line's number (for running in memory).
        ssim: rewrite the SSIM terms, too.
        masks: mask the renderings of every term, too.

    Raises:
        LegsError: no such folder; a site named by hand is not there; an expression that is nested too deeply.
    """
    root = check_root(path)
    files = read_files(root, exclude)
    edits: Dict[str, List[Edit]] = {}
    with _deep_recursion():
        findings = find(files.readable, by_hand, files.unread, ssim, masks)
        for name in sorted({site.path for site in findings.sites} | {call.path for call in findings.kept}):
            try:
                edits[name] = _edits(findings, name, in_place)
            except RecursionError:
                findings.without([name])
                findings.unreadable.append(Unreadable(name, "is nested too deeply"))
    findings.unreadable[:0] = files.unreadable
    for name, line in by_hand:
        if not any(site.path == name and site.named_by(line) for site in findings.sites) and not any(
            left.path == name and left.line == line for left in findings.patched
        ):
            why = next((entry.reason for entry in findings.unreadable if entry.path == name), None)
            why = why_left_out(root, name, exclude) or why
            if why is not None:
                raise LegsError(f"{name}:{line}: {why}")
            for problem in findings.problems:
                if (problem.path, problem.line) == (name, line):
                    raise LegsError(f"{name}:{line}: {problem.reason}; write there: {problem.advice}")
            raise LegsError(f"there is no difference, absolute value or call of two images at {name}:{line}")
    after = {name: apply_edits(findings.program.sources[name].data, made) for name, made in edits.items()}
    return Plan(root, findings, edits, after)


def _edits(findings: Findings, name: str, in_place: bool) -> List[Edit]:
    """Return the edits of one file."""
    source, module = findings.program.sources[name], findings.program.module(name)
    assert module is not None
    sites = [site for site in findings.sites if site.path == name]
    kept = [call for call in findings.kept if call.path == name]
    return rewrite(source, module, sites, kept, in_place)


def write(plan: Plan, force: bool = False) -> List[str]:
    """Write a plan; return the paths that were written.

    Raises:
        LegsError: the git tree has changes that are not the patch's own, and not ``force``; another user patched this
            checkout; or a file cannot be written. Nothing is written then.
    """
    root = plan.root
    if not plan.after and plan.settings is None:
        return []
    with locked(root, f"legs-patch {root}"):
        journal = Journal.read(root)
        dirty = [] if force else [name for name in changed_files(root) if not _is_patched(root, name, journal)]
        changes: Dict[str, Tuple[Optional[bytes], Optional[bytes]]] = {}
        for path, data in plan.after.items():
            source = plan.findings.program.sources[path]
            edits = tuple((edit.start, edit.end, edit.after.decode("utf-8")) for edit in sorted(plan.edits[path]))
            journal.files.setdefault(path, []).append(Layer(source.data, edits, digest(data)))
            changes[path] = (source.data, data)
        settings = _settings_change(plan, journal)
        if settings is not None:
            changes[SETTINGS_FILE] = settings
        if not changes:
            return []
        if not journal.ours:
            raise LegsError(
                f"{root / JOURNAL} is not yours: this checkout was patched by someone else, or on another machine; "
                f"nothing was changed. Undo that patch first: see legs-patch --undo {root}"
            )
        if dirty:
            shown = ", ".join(dirty[:5]) + (f" and {len(dirty) - 5} more" if len(dirty) > 5 else "")
            raise LegsError(f"the git tree has uncommitted changes ({shown}): commit them, or use --force")
        # The journal is written first, so that --undo works whatever happens next.
        replace_files(root, {JOURNAL: (journal.data, journal.dump(root)), **changes})
    return list(changes)


def _is_patched(root: Path, path: str, journal: Journal) -> bool:
    """Return whether a file is as an earlier patch wrote it."""
    try:
        data = read_file(root, path)
    except LegsError:
        return False
    return data is not None and journal.wrote(path, data)


def _settings_change(plan: Plan, journal: Journal) -> Optional[Tuple[Optional[bytes], Optional[bytes]]]:
    if plan.settings is None:
        return None
    data = plan.settings.encode("utf-8")
    current = read_file(plan.root, SETTINGS_FILE)
    if current == data:
        return None
    if current is not None and not journal.wrote(SETTINGS_FILE, current):
        raise LegsError(f"{SETTINGS_FILE} exists and is not as legs-patch wrote it: change the settings in it")
    journal.created[SETTINGS_FILE] = digest(data)
    return current, data
