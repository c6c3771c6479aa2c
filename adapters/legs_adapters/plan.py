"""Plan a patch of a checkout, and write it: everything is computed before anything is written."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from pathlib import Path
from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

from legs_adapters.checkout.git import changed_files
from legs_adapters.checkout.replace import Changes, locked, read_file, replace_files
from legs_adapters.code.folders import first_of, why_left_out
from legs_adapters.code.sources import Unreadable, check_root, read_files
from legs_adapters.edit import rewrite
from legs_adapters.journal import JOURNAL, Journal, Layer
from legs_adapters.rules.find import find
from legs_adapters.settings import SETTINGS_FILE
from legs_adapters.terms.findings import Findings
from legs_adapters.terms.text import Edit, apply_edits
from legs_adapters.terms.traced import Trace
from legs_adapters.unsearched import Unsearched, unsearched
from legs_loss import LegsError


class Plan(NamedTuple):
    """A patch that was computed and not yet written.

    Attributes:
        root: the checkout.
        findings: what was found in it.
        edits: by path, the edits of each file.
        after: by path, the bytes that each file would have.
        unsearched: what may be the loss in folders that are not searched.
        settings: the text of legs.toml, where one is to be written.
    """

    root: Path
    findings: Findings
    edits: Dict[str, List[Edit]]
    after: Dict[str, bytes]
    unsearched: Sequence[Unsearched] = ()
    settings: Optional[str] = None

    def source(self, path: str) -> bytes:
        """Return a file's bytes as they were read."""
        return self.findings.program.sources[path].data

    def changes(self) -> Changes:
        """Return by path the bytes before (None: no file) and after, of files that differ."""
        changes: Changes = {path: (self.source(path), after) for path, after in self.after.items()}
        if self.settings is not None:
            before, after = read_file(self.root, SETTINGS_FILE), self.settings.encode("utf-8")
            if before != after:
                changes[SETTINGS_FILE] = before, after
        return changes


@contextlib.contextmanager
def _large_trees() -> Iterator[None]:
    """Make room for expressions of some thousand parts and for files of some thousand functions.

    Raises:
        LegsError: a longer expression.
    """
    before, collects = sys.getrecursionlimit(), gc.isenabled()
    gc.disable()  # syntax trees live to the end: looking at them again finds no garbage
    # Before Python 3.11 a Python call takes some of the process's stack.
    sys.setrecursionlimit(max(before, 20_000 if sys.version_info >= (3, 11) else 6_000))
    try:
        yield
    except RecursionError:
        why = "an expression of thousands of parts is nested too deeply: skip its file with --exclude"
        raise LegsError(why) from None
    finally:
        sys.setrecursionlimit(before)
        if collects:
            gc.freeze()
            gc.unfreeze()  # to the oldest generation: the trees outlive this, and are not looked at for what is new
            gc.enable()


def plan(
    path: str | os.PathLike[str],
    exclude: Sequence[str] = (),
    by_hand: Sequence[Tuple[str, int]] = (),
    in_place: bool = False,
    ssim: bool = False,
    masks: bool = False,
    trace: Optional[Trace] = None,
) -> Plan:
    """Compute a patch, and write nothing.

    Args:
        path: the checkout.
        exclude: globs of files and folders to ignore.
        by_hand: (relative path, line) of the sites; the others are not sites then.
        in_place: keep every line's number (for running in memory).
        ssim: rewrite the SSIM terms, too.
        masks: mask the renderings of every term, too.
        trace: what a run of the training script showed.

    Raises:
        LegsError: no such folder; a site named by hand is not there; an expression that is nested too deeply.
    """
    root = check_root(path)
    readable, unreadable = read_files(root, exclude)
    with _large_trees():
        findings = find(readable, by_hand, ssim, masks, trace)
        edits = _edits(findings, in_place)
        elsewhere = tuple(unsearched(root, findings.program.budget, exclude))
    findings.unreadable[:0] = unreadable
    for name, line in by_hand:
        _check_named(root, findings, name, line, exclude)
    after = {name: apply_edits(findings.program.sources[name].data, made) for name, made in edits.items()}
    return Plan(root, findings, edits, after, elsewhere)


def _check_named(root: Path, findings: Findings, name: str, line: int, exclude: Sequence[str]) -> None:
    """Raise a LegsError that says why a site that was named by hand is none."""
    is_site = any(site.path == name and site.line <= line <= site.last_line for site in findings.sites)
    if is_site or (name, line) in [(entry.path, entry.line) for entry in findings.patched]:
        return
    reasons = [why_left_out(root, name, exclude), *(one.reason for one in findings.unreadable if one.path == name)]
    here = [problem for problem in findings.problems if (problem.path, problem.line) == (name, line)]
    reasons += [f"{problem.reason}; {problem.way}" for problem in here]
    why = next(filter(None, reasons), "there is no difference, absolute value or call of two images")
    raise LegsError(f"{name}:{line}: {why}")


def _edits(findings: Findings, in_place: bool) -> Dict[str, List[Edit]]:
    """Return the edits of each file. One that cannot be edited is given up, and the others are edited without it."""
    edits: Dict[str, List[Edit]] = {}
    calling = {use.caller.module.path for use, _ in findings.unweighted}
    for name in sorted({site.path for site in findings.sites} | calling):
        try:
            edits[name] = rewrite(findings, name, in_place)
            continue
        except RecursionError:
            why = "is nested too deeply"
        except LegsError:
            raise
        except ValueError as error:
            why = str(error)
        findings.without([name])
        if any(use.caller.module.path == name for use, _ in findings.unweighted):
            raise LegsError(f"{name} calls what is weighted, and cannot be edited (it {why}): skip it with --exclude")
        findings.unreadable.append(Unreadable(name, why))
        return _edits(findings, in_place)
    return edits


def write(plan: Plan, force: bool = False) -> List[str]:
    """Write a plan; return the paths that were written.

    Raises:
        LegsError: a file of it has uncommitted changes that are not the patch's own, and not ``force``; or a
            file or the journal cannot be written. Nothing is written then.
    """
    root = plan.root
    if not plan.after and plan.settings is None:
        return []
    with locked(root, f"legs-patch {root}") as stop:
        journal = Journal.read(root)
        changes = plan.changes()
        if plan.settings is not None and SETTINGS_FILE in changes:
            current = changes[SETTINGS_FILE][0]
            if current is not None and not journal.is_as_written(SETTINGS_FILE, current):
                raise LegsError(f"{SETTINGS_FILE} exists and is not as legs-patch wrote it: change the settings in it")
            journal.created[SETTINGS_FILE] = [*filter(None, [current]), plan.settings.encode("utf-8")]
        if not changes:
            return []
        own = {path: plan.source(path) for path in plan.after if not journal.is_as_written(path, plan.source(path))}
        changed = [] if force else changed_files(root, own)
        if changed:
            files = first_of(changed, 5)
            raise LegsError(f"uncommitted changes in what would be patched ({files}): commit them, or use --force")
        for path in plan.after:
            journal.add(path, Layer(plan.source(path), plan.edits[path]))
        # The journal is written first, so that --undo works whatever happens next.
        replace_files(root, {JOURNAL: (journal.data, journal.dump()), **changes}, stop)
    return list(changes)
