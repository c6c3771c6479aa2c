"""Describe the rules, from what they say of themselves: for ``--explain``, for the documentation, for the tests."""

from __future__ import annotations

from typing import List

from legs_adapters.rules.order import RULES
from legs_loss import LegsError

__all__ = ["explain", "listed", "table"]


def explain(name: str) -> str:
    """Return what ``--explain`` prints of a rule, or of each rule with a reason.

    Raises:
        LegsError: there is no such rule.
    """
    rules = [rule for rule in RULES.values() if name == rule.id] or [r for r in RULES.values() if name == r.reason]
    if not rules:
        raise LegsError(f"there is no rule {name!r}; legs-patch --explain lists them")
    return "\n".join(f"{rule.id}: {rule.text}\n" for rule in rules)


def table() -> str:
    """Return the table of rules in docs/patching.md."""
    rows = [f"| `{rule.id}` | {rule.sentence()} | {rule.reason} |" for rule in RULES.values()]
    return "\n".join(["| rule | why it skips a term | `reason` |", "| --- | --- | --- |", *rows, ""])


def listed() -> str:
    """Return the rules, a line each."""
    wide = max(map(len, RULES))
    lines: List[str] = [f"  {name:<{wide}}  {rule.sentence()}" for name, rule in RULES.items()]
    return "\n".join(["rules, in the order in which they are checked:", *lines, ""])
