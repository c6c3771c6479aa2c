"""Report what a run found and did, as a table for people and as JSON for scripts; and show the diff."""

from __future__ import annotations

import io
import json
from typing import Any, Dict, List, Optional, Sequence, Tuple

from legs_adapters.checkout.comparing import unified_diff
from legs_adapters.checkout.replace import Changes
from legs_adapters.code.syntax import call_name, one_line
from legs_adapters.plan import Plan
from legs_adapters.rules.order import RULES
from legs_adapters.terms.findings import Findings, Left, Problem
from legs_adapters.terms.form import Form
from legs_adapters.terms.traced import Trace
from legs_loss.system.terminal import printable


def as_table(plan: Plan) -> str:
    """Return one line for every L1 term: its place, the verdict, and the reason."""
    found = plan.findings
    rows: List[Tuple[str, int, str, str]] = []
    rows += [(site.path, site.line, "patched", site.why + _unseen(found, site)) for site in found.sites]
    for use, site in found.unweighted:
        path, line, _, reason, *_ = use.left
        why = f"{reason}: {call_name(use.call)} is weighted at {site.path}:{site.line}, in this call it is not"
        rows.append((path, line, "plain", why))
    rows += [(entry.path, entry.line, "already patched", "") for entry in found.patched]
    rows += [(entry.path, entry.line, "skipped", _why_left(entry) + _unseen(found, entry)) for entry in found.left]
    rows += [(entry.path, entry.line, "ERROR", entry.reason + _unseen(found, entry)) for entry in found.problems]
    table = [(printable(f"{path}:{line}"), what, printable(why)) for path, line, what, why in sorted(rows)]
    table += [(printable(entry.path), "not read", printable(entry.reason)) for entry in found.unreadable]
    wide, wider = (max((len(row[column]) for row in table), default=0) for column in (0, 1))
    return "".join(f"{where:<{wide}}  {what:<{wider}}  {why}".rstrip() + "\n" for where, what, why in table)


def _unseen(found: Findings, entry: Any) -> str:
    """Return the words of a term that a trace did not run; nothing without a trace."""
    return "" if found.trace is None or (entry.path, entry.line) in found.ran else "; not run in the trace"


def _traced(trace: Trace) -> List[Dict[str, object]]:
    """Return the terms of a trace for a script, each at the innermost line of the checkout."""
    names = ("kind", "share", "gaussians", "parameters", "stepped", "shape", "steps")
    return [
        {
            "file": term.frames[0][0], "line": term.frames[0][1], "is_photometric": term.is_photometric,
            "why": term.text(""), "image": term.match if term.is_known else None, "nearest": term.match,
            "through": [f"{path}:{line}" for path, line, *_ in term.frames],
            **{name: getattr(term, name) for name in names},
        }
        for term in trace.terms
    ]  # fmt: skip


def _why_left(left: Left) -> str:
    """Return why a term is skipped: the sentence of its rule, and the first deciding line."""
    if not left.rule:
        return left.reason
    path, line, text = left.because[0]
    here = f"line {line}" if path == left.path else f"{path}:{line}"
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"{RULES[left.rule].sentence().rstrip('.')} (rule {left.rule}, {here}: {text})"


def as_json(plan: Plan, wrote: Sequence[str]) -> str:
    """Return all of it for a script; see docs/patching.md for the fields."""
    found = plan.findings

    def line(entry: Any, code: Optional[str] = None, **more: object) -> Dict[str, object]:
        return {"file": entry.path, "line": entry.line, "code": entry.text if code is None else code, **more}

    def term(form: Form) -> Dict[str, str]:
        return {"term": form.term} if form.term else {}

    def problem(entry: Problem) -> Dict[str, object]:
        site = f"{entry.path}:{entry.line}" if entry.by_site else None
        return line(entry, reason=entry.reason, advice=entry.advice, site=site)

    content: Dict[str, object] = {
        "root": str(plan.root),
        "sites": [
            line(site, one_line(site.form.node), column=site.column, function=site.scope.name, **term(site.form))
            for site in found.sites
        ],
        "plain": [
            line(use.left, reason=use.left.reason, weighted_at=f"{site.path}:{site.line}")
            for use, site in found.unweighted
        ],
        "left": [
            line(left, reason=left.reason, rule=left.rule or None, because=[line(at) for at in left.because])
            for left in found.left
        ],
        "patched": [line(entry) for entry in found.patched],
        "problems": [problem(entry) for entry in found.problems],
        "doubts": [problem(entry) for entry in found.doubts],
        "unreadable": [{"file": entry.path, "reason": entry.reason} for entry in found.unreadable],
        "unsearched": [
            {"folder": at.folder, "reason": at.why, "file": at.path, "line": at.line, "advice": at.text(plan.root)}
            for at in plan.unsearched
        ],
        "would_change": sorted(plan.after),
        "wrote": list(wrote),
    }
    if found.trace is not None:
        content["traced"] = _traced(found.trace)
    return json.dumps(content, indent=2) + "\n"


def as_diff(changes: Changes) -> str:
    """Return a unified diff of files' bytes before and after; None is no file."""
    shown: List[str] = []
    for path, (before, after) in changes.items():
        names = "/dev/null" if before is None else f"a/{path}", "/dev/null" if after is None else f"b/{path}"
        for line in unified_diff(_lines(before), _lines(after), names):
            shown.append(line if line.endswith("\n") else f"{line}\n\\ No newline at end of file\n")
    return "".join(shown)


def _lines(data: Optional[bytes]) -> List[str]:
    """Return the lines of a file as they end there; splitlines() would also split at form feeds."""
    return list(io.StringIO((data or b"").decode("utf-8", "replace"), newline="\n"))
