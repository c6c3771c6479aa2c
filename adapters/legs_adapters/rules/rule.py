"""The base class of the rules that skip terms, and the terms that they are given.

A rule is a class in ``causes/``, or a row of one. Its docstring says why in one sentence, then shows code with a term
that it skips ("skipped:"), and code that is weighted ("weighted:"); all are tests. ``order.py`` lists the rules as they
are asked.
"""

from __future__ import annotations

import ast
import inspect
from typing import TYPE_CHECKING, Callable, Iterator, List, Optional, Sequence, Tuple

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import said_by, walk_expressions
from legs_adapters.lexicon.masks import is_rows
from legs_adapters.lexicon.meaning import swapped
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.form import Form
from legs_adapters.terms.sides import Pair, pair_of

if TYPE_CHECKING:
    from legs_adapters.rules.analysis import Analysis

_DEPTH = 3


class Term:
    """A photometric term, and the analyses of its program.

    Attributes:
        analysis: those analyses.
        function: the function that it stands in.
        form: the expression.
        here: the term, as evidence.
        pair: its two sides, and what they depict.
        target, prediction: the side that is the photograph, the second where neither name says so; and the other.
    """

    def __init__(self, analysis: Analysis, function: Function, form: Form) -> None:
        self.analysis = analysis
        self.function = function
        self.form = form
        self.here: List[Decider] = [(function, form.node)]
        self.pair: Pair = pair_of(analysis.meanings, analysis.ways, function, form)
        first, second = self.pair.first, self.pair.second
        is_swapped = swapped(self.pair.a, self.pair.b)
        self.target: ast.expr = first if is_swapped else second
        self.prediction: ast.expr = second if is_swapped else first

    @property
    def sides(self) -> Sequence[ast.expr]:
        """Both sides as they are written."""
        return self.form.first, self.form.second

    @property
    def trains_gaussians(self) -> bool:
        """Return whether both sides are proven, and what an optimiser then moves is known to have Gaussians."""
        return self.pair.is_proven and self.analysis.purposes.moves_gaussians(self.function, self.form.call)

    @property
    def has_rows(self) -> bool:
        """Return whether a side is a list of pixels, without neighbours."""
        sides = self.pair.first, self.pair.second
        return any(is_rows(self.analysis.meanings, self.function, side) for side in sides)

    @property
    def names_around(self) -> Iterator[Tuple[str, Decider]]:
        """The names of the function and of its class, each with where it stands."""
        yield self.function.name, header(self.function)
        owner = self.analysis.program.owner_of(self.function)
        if owner is not None:
            yield owner.name, (owner.parent, owner.node)


class Rule:
    """One cause to skip a term.

    Attributes:
        id: its name, for the report.
        reason: the word in the JSON report; several rules may share it.
        needs_target: warn of the term only if a side is known to be the photograph.
        is_doubted_beside_sites: warn of the term also where the codebase has other terms.
    """

    id: str = ""
    reason: str = ""
    needs_target = True
    is_doubted_beside_sites = True

    def sentence(self) -> str:
        """Return why a term is skipped."""
        return " ".join(self.text.partition("\n\n")[0].split())

    @property
    def text(self) -> str:
        """The docstring: why a term is skipped, and examples."""
        return inspect.cleandoc(self.__doc__ or "").replace("``", "`")

    def evidence(self, term: Term) -> List[Decider]:
        """Return the evidence to skip a term; nothing where the rule does not apply."""
        raise NotImplementedError

    def may_be_loss(self, term: Term) -> bool:
        """Return whether a term that this rule skipped needs a warning, if nothing else is found."""
        return False


def header(function: Function) -> Decider:
    """Return the ``def`` of a function as evidence."""
    return function, function.node


def source_of(
    function: Function, node: ast.AST, says: Optional[Callable[[str], bool]] = None, depth: int = 0
) -> Optional[Decider]:
    """Return the name, string or definition that decides: in an expression, or in the values that it is made from.

    Args:
        function: where the expression stands.
        node: the expression.
        says: a predicate on the text of a name or string; without it the nearest definition is returned.
        depth: how many definitions were followed already.
    """
    parts = list(walk_expressions(node))
    for part in parts if says is not None else ():
        if says is not None and said_by(part) and says(said_by(part)):
            return function, part
    definitions = [made for part in parts for made in function.flow.reaching(part)]
    for made in definitions if depth < _DEPTH else ():
        if made.value is not None:
            found = source_of(function, made.value, says, depth + 1) if says else (function, made.value)
            if found is not None:
                return header(function) if made.kind == "parameter" else found  # a default stands in the header
    return None
