"""Add the LEGS loss to a 3D Gaussian Splatting codebase, or remove it.

Finds the photometric L1 term of every training step in FOLDER and rewrites it to call legs_loss.l1_loss; evaluation,
scoring and every other L1 are not changed. Writes legs.toml to FOLDER, and a journal for --undo.
"""

from __future__ import annotations

import argparse
import atexit
import gc
import json
import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Dict, Mapping, Optional, Sequence, Tuple

from legs_loss import OPERATORS, LegsError, __version__
from legs_loss.cli import Parser, exit_code, never_fail_to_print
from legs_loss.errors import require
from legs_loss.system.terminal import say

if TYPE_CHECKING:
    from legs_adapters.plan import Plan
    from legs_adapters.terms.findings import Problem
    from legs_adapters.trace.command import Command

HELP = "add the LEGS loss to a codebase, or remove it; the same as legs-patch"

SETTINGS = ("preset", "beta", "curve", "operator", "store")
EXIT_CODES = (
    "exit codes: 0 done, or nothing to do; 1 --check: something would change, or a term needs a manual edit, or "
    "--verify: a check failed; 2 nothing was changed: bad usage, no term that can be decided (--strict: one that "
    "cannot), uncommitted changes; 130 interrupted"
)


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run ``legs-patch`` with these arguments (default: the process's own) and return its exit code."""

    args = argparse.Namespace(folder="", undo=False)

    def work() -> int:
        never_fail_to_print()
        parser = Parser(prog="legs-patch", description=__doc__)
        add_arguments(parser)
        parser.add_argument("--version", action="version", version=f"legs-loss {__version__}")
        parser.offer_completion()
        return _run(parser.parse_args(argv, args))

    return exit_code("legs-patch", work, lambda: _so_far(args))


def run(args: argparse.Namespace) -> int:
    """Patch, undo or verify, as the arguments say, and return the exit code."""
    return exit_code("legs-patch", lambda: _run(args), lambda: _so_far(args))


def _so_far(args: argparse.Namespace) -> str:
    """Return what was done so far, from the journal: a command writes all files and the journal, or nothing."""
    if _journal(args.folder) == getattr(args, "before", _journal(args.folder)):
        return "; nothing was changed"
    undo_it = f"; the patch was already written; undo it with: legs-patch --undo {args.folder}"
    return "; the patch was already undone" if args.undo else undo_it


def check_parser() -> None:
    """Raise a LegsError that says how to install what Python 3.7 needs to parse, where it is missing."""
    if sys.version_info < (3, 8):
        require("legs-patch", "patch", "asttokens")


def _run(args: argparse.Namespace) -> int:
    args.before = _journal(args.folder)
    if args.undo and (args.check or args.verify):
        raise LegsError("--undo can be combined with --diff and --force only")
    check_parser()
    if args.verify:
        require("legs-patch --verify", "cpu", "numba", "scipy")
    if args.undo:
        return _undo(args)
    if not args.verify:
        return _patch(args)
    from legs_adapters.verify import check_verifiable

    command = check_verifiable(args.folder, args.script, args.arguments, args.trace, args.cpu)
    return _patch(args) or _verify(args, command)


_MODES = {
    "--diff": "show what would change as a unified diff; write nothing",
    "--check": "exit with 1 if something would change; write nothing",
    "--verify": "patch, then train copies on the CPU with and without the patch for a few dozen steps, and compare",
}
_GROUPS = {
    "the loss, written to legs.toml": {
        "--preset NAME": "3dgs, eggs, legs-l, legs or legs-robust; default: legs",
        "--beta X": "weight of the strongest response, minus 1",
        "--curve NAME": "C1 to C5",
        "--operator NAME": f"one of {', '.join(OPERATORS)}",
        "--store DIR": "weight maps that legs precompute wrote",
    },
    "advanced: which terms": {
        "--strict": "patch nothing where a term cannot be decided",
        "--site FILE:LINE": "patch this term, and no other; repeatable",
        "--exclude GLOB": "files or folders to ignore; repeatable",
        "--ssim": "also rewrite the training step's SSIM to legs_loss.ssim, which is faster, where it is that of 3DGS",
        "--masks": "also write the line that hides masked pixels from every other term of the step",
    },
    "advanced: with --trace": {
        "--steps N": "end the script after N steps that move what is rendered; default: 30",
        "--cpu": "run it without a GPU, with shims for CUDA modules; on the embedded scene if it names none",
        "--photos DIR": "the folder of the photographs; default: those that the scene's model lists",
    },
    "advanced: safety and scripts": {
        "--force": "patch files with uncommitted changes, too; with --undo: restore the patched lines of files that "
        "were edited since, and keep the edits",
        "--json": "report as JSON",
    },
    "advanced: with --verify": {
        "--script FILE": "the training script; default: the file of the term",
        "--iterations N": "steps to compare; default: 40",
        "--arguments TEXT": "the script's arguments, with {scene}, {output}, {iterations}, {port} filled in; default: "
        "those of Inria's train.py that the script declares",
    },
}
_KINDS: Dict[str, Dict[str, Any]] = {  # of those that are more than a text or a switch
    "--beta": {"type": float},
    "--site": {"action": "append", "default": []},
    "--exclude": {"action": "append", "default": []},
    "--iterations": {"type": int, "default": 40},
    "--steps": {"type": int, "default": 30},
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``legs-patch`` and ``legs patch``: what most use first, the advanced ones last."""
    parser.epilog = EXIT_CODES
    parser.add_argument("folder", metavar="FOLDER", help="the checkout")
    _declare(parser.add_mutually_exclusive_group(), _MODES)
    text = "run this command in FOLDER for a few steps, and let what it compares decide which term is weighted"
    undo = "undo the patch, byte for byte; with --diff: show what would change"
    _declare(parser, {"--trace COMMAND": text, "--undo": undo})
    for title, options in _GROUPS.items():
        _declare(parser.add_argument_group(title), options)


def _declare(group: argparse._ActionsContainer, options: Mapping[str, str]) -> None:
    """Declare options with their help: one with a word behind it takes a value, one without is a switch."""
    for words, text in options.items():
        name, _, value = words.partition(" ")
        kind: Dict[str, Any] = {"metavar": value} if value else {"action": "store_true"}
        group.add_argument(name, help=text, **{**kind, **_KINDS.get(name, {})})


def _patch(args: argparse.Namespace) -> int:
    from legs_adapters.code.sources import check_root
    from legs_adapters.plan import plan, write
    from legs_adapters.report import as_diff
    from legs_adapters.settings import SETTINGS_FILE, settings_text
    from legs_adapters.terms.instead import offered, trained_instead
    from legs_adapters.trace.tracing import trace
    from legs_adapters.undo import unrecorded
    from legs_adapters.unsearched import unread

    if not args.trace and (args.cpu or args.photos):
        raise LegsError('--cpu and --photos belong to --trace "SCRIPT ARGUMENTS"')
    atexit.register(gc.freeze)  # at its end the process frees all memory at once: no tree is looked at again
    root = check_root(args.folder)
    settings = {name: getattr(args, name) for name in SETTINGS if getattr(args, name) is not None}
    text = settings_text(root, settings)
    writes = bool(settings) or not (root / SETTINGS_FILE).exists()  # else the user's, or an earlier run's, stays
    seen = trace(root, args.trace, args.steps, args.cpu, args.photos) if args.trace else None
    by_hand = [_site(root, text) for text in args.site]
    found = plan(root, args.exclude, by_hand, ssim=args.ssim, masks=args.masks, trace=seen)
    for elsewhere in found.unsearched:
        say(f"legs-patch: warning: {elsewhere.text(args.folder)}", sys.stderr)
    problems, is_decided = found.findings.problems, bool(found.findings.sites or found.findings.patched)
    instead = list(trained_instead(root, args.exclude, found.findings))
    if not is_decided or (problems and args.strict):
        _show(args, found)
        if not problems:
            what = offered(found.findings) + unread(root, args.exclude, found.findings)
            raise LegsError(f"no photometric L1 term was found in {args.folder}: {what}", *instead)
        _quote(problems, "error", instead)
        ways = ["--site FILE:LINE takes your word", "--exclude leaves files out"]
        ways = ways if args.trace else ['--trace "train.py ARGUMENTS" decides by a few steps', *ways]
        say(f"legs-patch: nothing was changed: {', '.join(ways)}", sys.stderr)
        return 2
    if writes:
        found = found._replace(settings=text)
    _quote(found.findings.doubts, "warning: a possible loss was not weighted", [f"warning: {line}" for line in instead])
    wrote = [] if args.diff or args.check else write(found, args.force)
    _show(args, found, wrote)
    bare = unrecorded(root) if found.findings.patched else []
    for name, why in bare:
        say(f"legs-patch: {name} is weighted, and --undo leaves it so: {why}", sys.stderr)
    how = "" if bare else f"; undo it with: legs-patch --undo {shlex.quote(args.folder)}"
    text = f"\nwrote {', '.join(wrote)}{how}" if wrote else "\nnothing to do: it is patched"
    if args.check:
        text = "would change: " + ", ".join(sorted(found.after)) if found.after else "nothing would change"
    if not args.json:
        say(as_diff(found.changes()) if args.diff else text, end="" if args.diff else "\n", lines=True)
    _quote(problems, "error")
    return 1 if problems or (args.check and found.after) else 0


def _show(args: argparse.Namespace, found: Plan, wrote: Sequence[str] = ()) -> None:
    """Print the report; beside a diff to stderr: git apply takes the diff alone."""
    from legs_adapters.report import as_json, as_table

    text = as_json(found, wrote) if args.json else as_table(found)
    say(text, sys.stderr if args.diff and not args.json else None, end="", lines=True)


def _verify(args: argparse.Namespace, command: Command) -> int:
    from legs_adapters.verify import verify

    photos, by_hand = args.photos if args.cpu else None, bool(args.site)
    verdict = verify(args.folder, command, args.arguments, args.iterations, photos, by_hand)
    if args.json:
        say(json.dumps({"holds": verdict.claims, "runs": {name: run._asdict() for name, run in verdict.runs.items()}}))
    else:
        say("\n" + verdict.text(), end="", lines=True)
    return 0 if all(verdict.claims.values()) else 1


def _undo(args: argparse.Namespace) -> int:
    from legs_adapters.journal import JOURNAL
    from legs_adapters.report import as_diff
    from legs_adapters.settings import SETTINGS_FILE
    from legs_adapters.undo import undo

    changes, kept = undo(args.folder, args.force, look=args.diff)
    removed = [name for name, (_, after) in changes.items() if after is None]
    restored = [name for name in changes if name not in removed]
    is_weighted = any(name != SETTINGS_FILE for name, _ in kept)
    done = [f"restored {name}\n" for name in restored] + [f"removed {name}\n" for name in removed]
    if args.json:
        say(json.dumps({"restored": restored, "removed": removed, "kept": kept}, indent=2), lines=True)
    else:
        say(as_diff(changes) if args.diff else "".join(done), end="", lines=True)
    for name, reason in kept if not args.json else ():
        say(f"kept {name}: {reason}", stream=sys.stderr if args.diff else sys.stdout)
    if is_weighted and not args.diff:
        say(f"legs-patch: {JOURNAL} and legs.toml stay: put those lines back, and undo again", sys.stderr)
    return int(is_weighted)


def _journal(folder: str) -> bytes:
    """Return bytes that identify the state of a checkout's journal; empty without one."""
    try:
        found = os.lstat(os.path.join(folder, ".legs-patch.json"))
    except (OSError, ValueError):
        return b""
    return repr((found.st_ino, found.st_size, found.st_mtime_ns)).encode()


def _quote(terms: Sequence[Problem], what: str, more: Sequence[str] = ()) -> None:
    """Print terms that may need a manual edit, and further lines, to stderr."""
    for term in terms:
        say(f"legs-patch: {what}: {term.path}:{term.line}: {term.reason}", sys.stderr)
        say(f"    {term.text}", sys.stderr)
        say(f"  if this is the loss between rendering and photograph: {term.way}", sys.stderr)
    for line in more:
        say(f"legs-patch: {line}", sys.stderr)


def _site(root: Path, text: str) -> Tuple[str, int]:
    name, _, line = text.rpartition(":")
    if not name or not line.isdecimal() or len(line) > 9:
        raise LegsError(f"--site must be FILE:LINE, got {text!r}")
    for base in (root, Path.cwd()):
        full = Path(os.path.abspath(str(base / name)))
        if full.is_file() and root in full.parents:
            return full.relative_to(root).as_posix(), int(line)
    raise LegsError(f"--site {text}: there is no such file in {root}")


if __name__ == "__main__":
    sys.exit(main())
