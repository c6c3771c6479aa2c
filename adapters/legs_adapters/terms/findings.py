"""Hold what is found in a checkout: terms to weight, terms that are left, and terms that a person must settle."""

from __future__ import annotations

from typing import Dict, Iterator, List, NamedTuple, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.program import Program
from legs_adapters.code.sources import Unreadable
from legs_adapters.lexicon.views import View
from legs_adapters.terms.form import Form

__all__ = ["Decider", "Evidence", "Findings", "Kept", "Left", "Line", "Problem", "Site"]

Decider = Tuple[Function, cst.CSTNode]


class Kept(NamedTuple):
    """A call that stays unweighted although the function it calls has a site in it.

    Attributes:
        path, line, text: where it stands, and what that line says.
        reason: what it is for, in one word.
        function: what is called.
        call: all of it.
        scope: the function that it stands in.
    """

    path: str
    line: int
    text: str
    reason: str
    function: str
    call: cst.Call
    scope: Function


class Site(NamedTuple):
    """One photometric L1 term.

    Attributes:
        path, line, column: where it begins; the line counts from 1, the column from 0.
        last_line: where it ends.
        form: the expression.
        swapped: the ground truth is the first of the two arguments.
        selection: the index by a mask that both arguments carry, as written with its brackets, and the one that a named
            difference of them is taken with; empty without.
        channels_last: the images are [H, W, C].
        view: the verdict on ``view=``.
        scope: the function that it stands in.
        aside: other reads of the same error map, which are not the loss and keep the plain one.
        kept: calls of that function that are not the loss.
    """

    path: str
    line: int
    column: int
    last_line: int
    form: Form
    swapped: bool
    selection: str
    channels_last: bool
    view: View
    scope: Function
    aside: Tuple[cst.Name, ...] = ()
    kept: Tuple[Kept, ...] = ()

    @property
    def function(self) -> str:
        """The name of the function that it stands in."""
        return self.scope.name

    def named_by(self, line: int) -> bool:
        """Return whether a line that a person names is one of its lines."""
        return self.line <= line <= self.last_line


class Line(NamedTuple):
    """A line of a checkout: where it is, and what it says."""

    path: str
    line: int
    text: str


class Evidence(NamedTuple):
    """The rule for which a term is left, and what decided it.

    Attributes:
        rule: the rule's id.
        reason: its word for the report.
        deciders: the nodes that decided, each with the function that it stands in.
    """

    rule: str
    reason: str
    deciders: Sequence[Decider]

    @property
    def lines(self) -> List[Line]:
        """The lines that decided; none in a file in which LibCST cannot place them."""
        return [line for decider in self.deciders for line in _lines(*decider)]


def _lines(function: Function, node: cst.CSTNode) -> Iterator[Line]:
    if isinstance(node, cst.Module):
        return  # all of a file decides nothing that a line could show
    try:
        line = function.line if node is function.node else function.place(node).line
    except (KeyError, ValueError):  # a node that the analysis made, or a file that LibCST writes differently
        return
    yield Line(function.module.path, line, function.module.lines.text(line))


class Left(NamedTuple):
    """An L1 that was seen and left.

    Attributes:
        path, line, text: where it stands, and what that line says.
        reason: why, in one word.
        evidence: the rule and what decided; None where no rule did.
    """

    path: str
    line: int
    text: str
    reason: str
    evidence: Optional[Evidence] = None

    @classmethod
    def at(cls, function: Function, place: Place, why: str | Evidence) -> Left:
        """Return what stands at a place as left: for what a rule found, or for a reason that no rule has."""
        reason, evidence = (why, None) if isinstance(why, str) else (why.reason, why)
        return cls(function.module.path, place.line, function.module.lines.text(place.line), reason, evidence)

    @property
    def because(self) -> List[Line]:
        """The lines that decided; its own where those cannot be placed."""
        return (self.evidence.lines if self.evidence else []) or [Line(self.path, self.line, self.text)]


class Problem(NamedTuple):
    """A term that a person must settle: where it is, what it says, and what to write there by hand."""

    path: str
    line: int
    text: str
    reason: str
    advice: str

    @classmethod
    def at(cls, function: Function, place: Place, reason: str, advice: str) -> Problem:
        """Return what stands at a place of a function as a problem."""
        return cls(function.module.path, place.line, function.module.lines.text(place.line), reason, advice)


class Findings(NamedTuple):
    """All that was found; in the order of the files.

    ``doubts`` are of what was left in a file that trains, where nothing else is weighted: perhaps the loss after all.
    """

    sites: List[Site]
    left: List[Left]
    problems: List[Problem]
    doubts: List[Problem]
    patched: List[Left]
    unreadable: List[Unreadable]
    program: Program

    @property
    def kept(self) -> Dict[Kept, Site]:
        """The calls that stay unweighted, each with a site in the function that it calls."""
        return {kept: site for site in self.sites for kept in site.kept}
