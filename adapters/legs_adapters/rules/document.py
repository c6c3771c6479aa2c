"""Describe the rules, from what they say of themselves: for ``--explain``, for the documentation, for the tests."""

from __future__ import annotations

import difflib
from textwrap import dedent, indent
from typing import List, NamedTuple

from legs_adapters.rules.order import RULES
from legs_adapters.rules.rule import Rule
from legs_loss import LegsError

__all__ = ["Description", "describe", "explain", "listed", "table"]


class Description(NamedTuple):
    """A rule in words: why it skips a term, code that it skips, and code that is weighted."""

    why: str
    left: List[str]
    weighted: List[str]


def describe(rule: Rule) -> Description:
    """Return why a rule skips a term, and its snippets."""
    snippets = ([dedent(text).strip() for text in texts] for texts in (rule.INVALID, rule.VALID))
    return Description(rule.sentence(), *snippets)


def explain(name: str) -> str:
    """Return what ``--explain`` prints of a rule, or of each rule with a reason.

    Raises:
        LegsError: there is no such rule; the message proposes a similar name.
    """
    rules = [rule for rule in RULES.values() if name == rule.id] or [r for r in RULES.values() if name == r.reason]
    if not rules:
        near = difflib.get_close_matches(name.lower(), [*RULES, *(rule.reason for rule in RULES.values())], 1)
        guess = f"; did you mean {near[0]}?" if near else ""
        raise LegsError(f"there is no rule {name!r}{guess or '; legs-patch --explain lists them'}")
    return "\n".join(_explained(rule) for rule in rules)


def table() -> str:
    """Return the table of rules in docs/patching.md."""
    rows = [f"| `{rule.id}` | {rule.sentence()} | {rule.reason} |" for rule in RULES.values()]
    return "\n".join(["| rule | why it skips a term | `reason` |", "| --- | --- | --- |", *rows, ""])


def _explained(rule: Rule) -> str:
    why, left, weighted = describe(rule)
    parts = [f"{rule.id}: skipped", f"  {why}"]
    for title, snippets in (("skipped", left), ("weighted", weighted)):
        parts += [f"\n  {title}:", "\n\n".join(indent(snippet, "    ") for snippet in snippets)]
    return "\n".join([*parts, ""])


def listed() -> str:
    """Return the rules, a line each."""
    wide = max(map(len, RULES))
    lines: List[str] = [f"  {name:<{wide}}  {describe(rule).why}" for name, rule in RULES.items()]
    return "\n".join(["rules, in the order in which they are checked:", *lines, ""])
