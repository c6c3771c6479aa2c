"""Report what a run found and did, as a table for people and as JSON for scripts; and show the diff."""

from __future__ import annotations

import json
from typing import Dict, List, Mapping, Optional, Sequence, Tuple

from legs_adapters.checkout.comparing import Effort, unified_diff
from legs_adapters.code.syntax import one_line
from legs_adapters.plan import Plan
from legs_adapters.settings import SETTINGS_FILE
from legs_adapters.terms.findings import Left
from legs_loss.system import printable

__all__ = ["as_diff", "as_json", "as_table", "changes_as_diff"]


_RED, _GREEN, _CYAN, _BOLD, _PLAIN = "\033[31m", "\033[32m", "\033[36m", "\033[1m", "\033[0m"


def as_table(plan: Plan) -> str:
    """Return one line for every L1 term: its place, the verdict, and the reason."""
    rows: List[Tuple[str, int, str, str]] = []
    found = plan.findings
    for site in found.sites:
        rows.append((site.path, site.line, "patched", site.why))
    for kept, site in found.kept.items():
        why = f"{kept.reason}: {kept.function} is weighted at {site.path}:{site.line}, in this call it is not"
        rows.append((kept.path, kept.line, "plain", why))
    rows += [(entry.path, entry.line, "already patched", "") for entry in found.patched]
    rows += [(entry.path, entry.line, f"skipped ({entry.reason})", _decided(entry)) for entry in found.left]
    rows += [(entry.path, entry.line, "ERROR", entry.reason) for entry in found.problems]
    rows.sort()
    table = [(printable(f"{path}:{line}"), what, printable(why)) for path, line, what, why in rows]
    table += [(printable(entry.path), "not read", printable(entry.reason)) for entry in found.unreadable]
    if not table:
        return ""
    wide, wider = (max(len(row[column]) for row in table) for column in (0, 1))
    return "".join(f"{where:<{wide}}  {what:<{wider}}  {why}".rstrip() + "\n" for where, what, why in table)


def _decided(left: Left) -> str:
    """Return the rule that skips a term, and the first deciding line."""
    if left.evidence is None:
        return ""
    path, line, text = left.because[0]
    here = f"line {line}" if path == left.path else f"{path}:{line}"
    text = text if len(text) <= 60 else text[:57] + "..."
    return f"rule {left.evidence.rule}, {here}: {text}"


def as_json(plan: Plan, wrote: Sequence[str]) -> str:
    """Return all of it for a script; see docs/patching.md for the fields."""
    found = plan.findings
    content: Dict[str, object] = {
        "root": str(plan.root),
        "sites": [
            {
                "file": site.path,
                "line": site.line,
                "column": site.column,
                "function": site.function,
                "code": one_line(site.form.node),
                **({} if site.form.weighs else {"term": site.form.term}),
            }
            for site in found.sites
        ],
        "plain": [
            {
                "file": kept.path,
                "line": kept.line,
                "code": kept.text,
                "reason": kept.reason,
                "weighted_at": f"{site.path}:{site.line}",
            }
            for kept, site in found.kept.items()
        ],
        "left": [
            {
                "file": e.path,
                "line": e.line,
                "code": e.text,
                "reason": e.reason,
                "rule": e.evidence.rule if e.evidence else None,
                "because": [{"file": at.path, "line": at.line, "code": at.text} for at in e.because],
            }
            for e in found.left
        ],
        "patched": [{"file": e.path, "line": e.line, "code": e.text} for e in found.patched],
        "problems": [
            {"file": e.path, "line": e.line, "code": e.text, "reason": e.reason, "advice": e.advice}
            for e in found.problems
        ],
        "doubts": [
            {"file": e.path, "line": e.line, "code": e.text, "reason": e.reason, "advice": e.advice}
            for e in found.doubts
        ],
        "unreadable": [{"file": e.path, "reason": e.reason} for e in found.unreadable],
        "would_change": sorted(plan.after),
        "wrote": list(wrote),
    }
    return json.dumps(content, indent=2) + "\n"


def as_diff(plan: Plan, colour: bool) -> str:
    """Return a unified diff of what would be written."""
    changes: Dict[str, Tuple[Optional[bytes], Optional[bytes]]] = {
        path: (plan.findings.program.sources[path].data, after) for path, after in plan.after.items()
    }
    if plan.settings is not None:
        changes[SETTINGS_FILE] = (None, plan.settings.encode("utf-8"))
    return changes_as_diff(changes, colour)


def changes_as_diff(changes: Mapping[str, Tuple[Optional[bytes], Optional[bytes]]], colour: bool) -> str:
    """Return a unified diff of files' bytes before and after; None is no file."""
    effort = Effort()
    parts = [
        printable(line, lines=True)
        for path, (before, after) in changes.items()
        for line in _unified(path, before, after, effort)
    ]
    return "".join(_coloured(line) if colour else line for line in parts)


def _unified(path: str, before: Optional[bytes], after: Optional[bytes], effort: Effort) -> List[str]:
    names = "/dev/null" if before is None else f"a/{path}", "/dev/null" if after is None else f"b/{path}"
    lines = unified_diff(_lines(before), _lines(after), names, effort)
    shown = []
    for line in lines:
        shown.append(line if line.endswith("\n") else line + "\n\\ No newline at end of file\n")
    return shown


def _lines(data: Optional[bytes]) -> List[str]:
    text = (data or b"").decode("utf-8-sig", "replace")
    # splitlines() would also split at form feeds and at letters that only look like line ends
    return (
        text.replace("\r\n", "\n").replace("\r", "\n").splitlines(keepends=True)
        if "\f" not in text
        else [line + "\n" for line in text.replace("\r\n", "\n").split("\n")]
    )


def _coloured(line: str) -> str:
    colour = {"+": _GREEN, "-": _RED, "@": _CYAN}.get(line[:1], "")
    if line.startswith(("+++", "---")):
        colour = _BOLD
    body = line.rstrip("\n")
    return f"{colour}{body}{_PLAIN}{line[len(body) :]}" if colour else line
