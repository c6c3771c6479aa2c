"""The form of a photometric term: what it compares, how it is edited, the advice where it cannot be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, List, Optional, Tuple, TypeVar

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import one_line
from legs_adapters.lexicon.masks import without_rows
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text
from legs_adapters.terms.writing import Writing

__all__ = ["Form"]

_F = TypeVar("_F", bound="Form")


@dataclass(frozen=True)
class Form:
    """An L1 between two expressions; each kind of it is a subclass in ``terms/kinds``.

    Attributes:
        node: all of the expression that is the L1 term.
        call: the call in it that has the two arguments, or that takes the absolute value.
        first, second: the two arguments, as written.
        callee: what is called, for a form that is a call of a function; None for ``abs``.
        extras: the call's further arguments.
        difference: the ``a - b``, for a form that is an absolute value.
        selection: the index of a named difference, ``[mask]``; empty without.
        makes: what becomes of the differences: "mean", "none" (the map), or "own", anything else that is an L1; see
            `L1Functions.shape`.
        order: of several kinds that recognise a call, the one with the lowest order is used.
        is_named: whether the difference is assigned to a name first, so that no single expression can be replaced.
        weighs: whether the edit weights the term.
        term: what it is a term of, in the JSON report.
        done: what the edit does to it, in words.
    """

    node: cst.BaseExpression
    call: cst.Call
    first: cst.BaseExpression
    second: cst.BaseExpression
    callee: Optional[cst.BaseExpression] = None
    extras: Tuple[cst.Arg, ...] = ()
    difference: Optional[cst.BinaryOperation] = None
    selection: str = ""
    makes: str = "own"

    order: ClassVar[int] = 0
    is_named: ClassVar[bool] = False
    weighs: ClassVar[bool] = True
    term: ClassVar[str] = "l1"
    done: ClassVar[str] = "is weighted"

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Return the form of a call, or None; some kinds are not found in calls."""
        return None

    @property
    def is_map(self) -> bool:
        """Return whether the term is an unreduced error map."""
        return self.makes == "none"

    @property
    def is_mean(self) -> bool:
        """Return whether the term is the plain mean."""
        return self.makes == "mean"

    @property
    def takes_index(self) -> bool:
        """Return whether `indexed` keeps the term's value."""
        return False

    def why_by_hand(self) -> str:
        """Return why the form cannot be edited, empty where it can."""
        return ""

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Return the edits that weight the term.

        Raises:
            LegsError: the term has to be weighted by hand.
        """
        raise NotImplementedError(type(self).__name__)

    def advice(self, writing: Writing, rows: bool) -> str:
        """Return the advice for a manual edit; ``rows`` where the images are lists of pixels."""
        prediction, target = writing.ordered(self.first, self.second)
        whole, other = without_rows(prediction), without_rows(target)
        if whole is not prediction and other is not target:
            image, photo = one_line(whole), one_line(other)
            return writing.call(image, f"{photo}.reshape({image}.shape)")
        return self._advice(writing, one_line(prediction), one_line(target), rows)

    def _advice(self, writing: Writing, prediction: str, target: str, rows: bool) -> str:
        if rows:
            return f"{writing.package}.l1_loss(rendering, photograph), on the images before they are flattened"
        return writing.call(prediction, target, self.is_map, self._own(writing))

    def _own(self, writing: Writing) -> str:
        return ""

    def moved(self: _F, selection: str) -> _F:
        """Return the form with another selection."""
        return replace(self, selection=selection)
