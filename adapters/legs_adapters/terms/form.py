"""The form of a photometric term: what it compares, how it is edited, the advice where it cannot be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, List, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import one_line
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text
from legs_adapters.terms.writing import Writing

__all__ = ["Form"]


@dataclass(frozen=True)
class Form:
    """An L1 between two expressions; each kind of it is a subclass in ``terms/kinds``.

    Attributes:
        node: all of the expression that is the L1 term.
        call: the call in it that has the two arguments, or that takes the absolute value.
        first, second: the two arguments, as written.
        callee: what is called, for a form that is a call of a function; None for ``abs``.
        extras: the call's further arguments.
        makes: what becomes of the differences: "mean", "none" (the map), or "own", anything else that is an L1; see
            `L1Functions.shape`.
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
    makes: str = "own"

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

    def why_by_hand(self) -> str:
        """Return why the form cannot be edited, empty where it can."""
        return ""

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Return the edits that weight the term.

        Raises:
            LegsError: the term has to be weighted by hand.
        """
        raise NotImplementedError(type(self).__name__)

    def advice(self, writing: Writing) -> str:
        """Return what to write by hand."""
        prediction, target = writing.ordered(one_line(self.first), one_line(self.second))
        return writing.call(prediction, target, self.is_map, self._own(writing))

    def _own(self, writing: Writing) -> str:
        return writing.own(self.callee, self.extras) if self.callee is not None and self.makes == "own" else ""
