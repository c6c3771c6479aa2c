"""The form of a photometric term: what it compares, how it is edited, the advice where it cannot be."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import ClassVar, List, Optional, Tuple

from legs_adapters.code.syntax import Arg
from legs_adapters.terms.text import Edit, Text, apply_edits, on_one_line
from legs_adapters.terms.writing import Writing


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
        term: what it is where the edit does not weight it, in the JSON report; empty where it does.
        done: what the edit does to it, in words.
    """

    node: ast.expr
    call: ast.Call
    first: ast.expr
    second: ast.expr
    callee: Optional[ast.expr] = None
    extras: Tuple[Arg, ...] = ()
    makes: str = "own"

    term: ClassVar[str] = ""
    done: ClassVar[str] = "is weighted"

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Return the edits that weight the term."""
        raise NotImplementedError(type(self).__name__)

    def advice(self, text: Text, writing: Writing) -> str:
        """Return what the edits write in the place of ``node``, on one line."""
        start, end = text.span(self.node)
        after = apply_edits(text.source.data, self.edits(text, writing))
        before, behind = len(text.source.data) - len(text.bytes) + start, len(text.bytes) - end
        return on_one_line(after[before : len(after) - behind].decode("utf-8"))
