"""The findings in a checkout: terms to weight, skipped terms, and terms that need a manual edit."""

from __future__ import annotations

import ast
from typing import TYPE_CHECKING, Any, Container, Dict, FrozenSet, Iterator, List, NamedTuple, Optional, Sequence, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.program import Program
from legs_adapters.code.sources import Unreadable
from legs_adapters.terms.form import Form
from legs_adapters.terms.text import on_one_line
from legs_adapters.terms.writing import Writing

if TYPE_CHECKING:
    from legs_adapters.terms.traced import Trace

Decider = Tuple[Function, ast.AST]


class Line(NamedTuple):
    """A line of a checkout: its place and its text."""

    path: str
    line: int
    text: str


class Evidence(NamedTuple):
    """The rule that skips a term, its word for the report, and the nodes that decided, each with its function."""

    rule: str
    reason: str
    deciders: Sequence[Decider]


class Left(NamedTuple):
    """A skipped L1.

    Attributes:
        path, line, text: its place, and the text of that line.
        reason: why, in one word.
        because: the lines that decided; its own where those cannot be placed.
        rule: the id of the rule that skips it; empty where none did.
    """

    path: str
    line: int
    text: str
    reason: str
    because: Tuple[Line, ...]
    rule: str = ""

    @classmethod
    def at(cls, function: Function, place: Place, why: str | Evidence) -> Left:
        """Return the term at a place as skipped: by a rule's evidence, or for another reason."""
        here = Line(function.module.path, place.line, function.module.lines.text(place.line))
        rule, reason, deciders = Evidence("", why, ()) if isinstance(why, str) else why
        return cls(*here, reason, tuple(_lines(deciders)) or (here,), rule)


def _lines(deciders: Sequence[Decider]) -> Iterator[Line]:
    for function, node in deciders:
        if hasattr(node, "lineno"):  # a whole file has no deciding line, nor has a node that the analysis made
            line = function.place(node).line
            yield Line(function.module.path, line, function.module.lines.text(line))


class Use(NamedTuple):
    """A call of a function that compares images.

    Attributes:
        caller, call: the call, and the function that it stands in.
        other: the evidence that it is not for the loss; None where it is.
        is_known: whether its arguments show which.
        target: what it is given as the photograph.
    """

    caller: Function
    call: ast.Call
    other: Optional[Evidence]
    is_known: bool
    target: str = ""

    @property
    def left(self) -> Left:
        """The call as one that is not weighted."""
        return Left.at(self.caller, self.caller.place(self.call), self.other or "")


class Site(NamedTuple):
    """One photometric L1 term.

    Attributes:
        path, line, column: where it begins; the line counts from 1, the column from 0.
        last_line: where it ends.
        form: the expression.
        swapped: the ground truth is the first of the two arguments.
        selection: the index by a mask that both arguments carry, as written with its brackets, and the one that a named
            difference of them is taken with; empty without.
        why: what is known of it, in words.
        scope: the function that it stands in.
        unweighted: the calls of that function that are not for the loss.
    """

    path: str
    line: int
    column: int
    last_line: int
    form: Form
    swapped: bool
    selection: str
    why: str
    scope: Function
    unweighted: Tuple[Use, ...] = ()

    def writing(self, in_place: bool = False) -> Writing:
        """Return how its weighted call is written."""
        return Writing(self.swapped, on_one_line(self.selection), in_place)

    @classmethod
    def at(cls, function: Function, form: Form, why: str, swapped: bool = False, selection: str = "") -> Site:
        """Return a form in a function as a site."""
        place = function.place(form.node)
        stands = (function.module.path, place.line, place.column, place.last_line)
        return cls(*stands, form, swapped, selection, why, function)


class Problem(NamedTuple):
    """A term that needs a manual edit: its place, its text, and the advice, in words or as ``--site`` writes it."""

    path: str
    line: int
    text: str
    reason: str
    advice: str
    by_site: bool = False

    @classmethod
    def at(cls, function: Function, place: Place, reason: str, advice: str, by_site: bool = False) -> Problem:
        """Return the term at a place of a function as a problem."""
        return cls(function.module.path, place.line, function.module.lines.text(place.line), reason, advice, by_site)

    @property
    def way(self) -> str:
        """The advice as a clause, for the case that it is the loss."""
        written = f"legs-patch --site {self.path}:{self.line} takes your word and writes {self.advice}"
        return written if self.by_site else f"edit it by hand: {self.advice}"


class Findings(NamedTuple):
    """All findings, in the order of the files.

    ``doubts`` are skipped terms that may be the loss: of files that train and have no weighted term, which are
    ``unsettled`` where they have none at all. ``trace`` is what a run showed, and ``ran`` the (path, line) of the terms
    that it met.
    """

    sites: List[Site]
    left: List[Left]
    problems: List[Problem]
    doubts: List[Problem]
    patched: List[Left]
    unreadable: List[Unreadable]
    program: Program
    unsettled: FrozenSet[str] = frozenset()
    trace: Optional[Trace] = None
    ran: FrozenSet[Tuple[str, int]] = frozenset()

    def with_more(self, **more: Sequence[Any]) -> Findings:
        """Return findings with further ones, ``sites=...``, each kind in the order of the files."""
        merged: Dict[str, Any] = {}
        for kind, entries in more.items():
            merged[kind] = sorted([*getattr(self, kind), *entries], key=lambda entry: (entry.path, entry.line))
        return self._replace(**merged)

    def without(self, paths: Container[str]) -> None:
        """Remove what was found in files that were then given up."""
        everything: Tuple[List[Any], ...] = (self.sites, self.left, self.problems, self.doubts, self.patched)
        for entries in everything:
            entries[:] = [entry for entry in entries if entry.path not in paths]

    @property
    def unweighted(self) -> List[Tuple[Use, Site]]:
        """The calls that are not weighted, each with a site in the function that it calls."""
        return list({use.call: (use, site) for site in self.sites for use in site.unweighted}.values())
