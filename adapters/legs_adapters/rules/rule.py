"""The base class of the rules that skip terms, and the terms and calls that they are given.

A rule is a class in ``causes/``, or a row of one. Its docstring says why in one sentence, `INVALID` are terms that it
skips, `VALID` terms that are weighted; all are tests. ``order.py`` lists the rules as they are asked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Callable, Iterator, List, Optional, Sequence, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import walk_expressions
from legs_adapters.lexicon.meaning import Meaning, swapped
from legs_adapters.terms.findings import Decider, Evidence
from legs_adapters.terms.form import Form
from legs_adapters.terms.sides import Pair, pair_of

if TYPE_CHECKING:
    from legs_adapters.rules.analysis import Analysis

__all__ = ["CallContext", "CallOfTerm", "Rule", "Term", "header", "source_of"]

_DEPTH = 3


class CallContext:
    """A call in a function, and the analyses of its program.

    Attributes:
        analysis: those analyses.
        function: the function that the call stands in.
        call: the call.
        here: the call, or the term, as evidence.
    """

    def __init__(self, analysis: Analysis, function: Function, call: cst.CSTNode) -> None:
        self.analysis = analysis
        self.function = function
        self.call = call
        self.here: List[Decider] = [(function, call)]

    @property
    def class_name(self) -> str:
        """The name of the class that the function is a method of; empty without."""
        owner = self.analysis.program.owner_of(self.function)
        return owner.name if owner is not None else ""

    @property
    def names_around(self) -> Iterator[Tuple[str, Decider]]:
        """The names of the function and of its class, each with where it stands."""
        yield self.function.name, header(self.function)
        owner = self.analysis.program.owner_of(self.function)
        if owner is not None:
            yield owner.name, (owner.parent, owner.node.name)


class Term(CallContext):
    """A photometric term.

    Attributes:
        form: the expression.
        pair: its two sides, and what they depict.
    """

    def __init__(self, analysis: Analysis, function: Function, form: Form, pair: Optional[Pair] = None) -> None:
        super().__init__(analysis, function, form.call)
        self.form = form
        self.here: List[Decider] = [(function, form.node)]
        self.pair: Pair = pair or pair_of(analysis.meanings, function, form)

    @property
    def sides(self) -> Sequence[cst.BaseExpression]:
        """Both sides as they are written."""
        return self.form.first, self.form.second

    @property
    def target(self) -> cst.BaseExpression:
        """The side that is the photograph; the second where neither name says so."""
        return self.pair.first if swapped(self.pair.a, self.pair.b) else self.pair.second

    @property
    def prediction(self) -> cst.BaseExpression:
        """The other side."""
        return self.pair.second if swapped(self.pair.a, self.pair.b) else self.pair.first


class CallOfTerm(CallContext):
    """A call of a function that compares two of its parameters.

    Attributes:
        given: what the call passes for the rendering, where that is known, and for the photograph.
    """

    def __init__(self, analysis: Analysis, caller: Function, call: cst.Call, given: Sequence[Meaning]) -> None:
        super().__init__(analysis, caller, call)
        self.given = given


class Rule:
    """One cause to skip a term.

    Attributes:
        id: its name, for ``--explain`` and the report.
        reason: the word in the report; several rules may share it.
        why: why a term is skipped, a sentence; default: the docstring.
        VALID, INVALID: code whose terms are weighted, and code with a term that the rule skips; the body of a training
            step, or functions.
        is_picture: the term compares pictures in a training step, of another kind than photographs.
        is_always_listed: the report lists the term, also where it is a bare absolute difference.
        is_listed_for_pictures: the report lists a bare absolute difference where it is of a rendering and a photograph.
        needs_target: warn of the term only if a side is known to be the photograph.
        is_doubted_beside_sites: warn of the term also where the codebase has other terms.
    """

    id: str = ""
    reason: str = ""
    why: str = ""
    VALID: List[str] = []
    INVALID: List[str] = []
    is_picture = False
    is_always_listed = False
    is_listed_for_pictures = False
    needs_target = True
    is_doubted_beside_sites = True

    def evidence(self, term: Term) -> List[Decider]:
        """Return the evidence to skip a term; nothing where the rule does not apply."""
        raise NotImplementedError

    def of_call(self, call: CallOfTerm) -> List[Decider]:
        """Return the evidence that a call is not for the loss; nothing where the rule does not apply."""
        return []

    def found(self, deciders: Sequence[Decider]) -> Evidence:
        """Return these nodes as evidence for this rule."""
        return Evidence(self.id, self.reason, deciders)

    def may_be_loss(self, term: Term) -> bool:
        """Return whether a term that this rule skipped needs a warning, if nothing else is found."""
        return False


def header(function: Function) -> Decider:
    """Return the ``def`` of a function as evidence."""
    return function, function.node


def source_of(
    function: Function, node: cst.CSTNode, says: Optional[Callable[[str], bool]] = None, depth: int = 0
) -> Optional[Decider]:
    """Return the name, string or definition that decides: in an expression, or in the values that it is made from.

    Args:
        function: where the expression stands.
        node: the expression.
        says: a predicate on the text of a name or string; without it the nearest definition is returned.
        depth: how many definitions were followed already.
    """
    parts = list(walk_expressions(node))
    for part in parts:
        if says is not None and isinstance(part, (cst.Name, cst.SimpleString)) and says(part.value):
            return function, part
    for part in parts if depth < _DEPTH else ():
        for made in sorted(function.flow.reaching(part), key=lambda definition: definition.order):
            if made.value is not None:
                found = source_of(function, made.value, says, depth + 1) if says else (function, made.value)
                if found is not None:
                    return header(function) if made.kind == "parameter" else found  # a default stands in the header
    return None
