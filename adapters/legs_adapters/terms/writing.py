"""Write the text of the weighted call, for edits and for advice."""

from __future__ import annotations

import ast
from typing import NamedTuple, Sequence, Tuple

from legs_adapters.code.syntax import Arg, code
from legs_adapters.terms.text import flat, names_for_two, on_one_line

PACKAGE = "legs_loss"


class Writing(NamedTuple):
    """The settings of the weighted call at one call site.

    Attributes:
        swapped: whether the target is the first of the two sides.
        selection: the index by a mask that both images carry, with its brackets; empty without.
        in_place: whether every line has to keep its number.
    """

    swapped: bool = False
    selection: str = ""
    in_place: bool = False

    def ordered(self, first: str, second: str) -> Tuple[str, str]:
        """Return the two sides as prediction and target."""
        return (second, first) if self.swapped else (first, second)

    def settings(self, as_map: bool = False, own: str = "") -> str:
        """Return the arguments after the two images, each with its comma.

        Args:
            as_map: whether the unreduced map is asked for.
            own: the codebase's own L1, where it is more than a mean.
        """
        return (', reduction="none"' if as_map else "") + (f", own={own}" if own else "")

    def own(self, callee: ast.expr, extras: Sequence[Arg]) -> str:
        """Return the codebase's own function of (prediction, target), with its further arguments."""
        name = on_one_line(code(callee, True))
        if not extras and not self.selection and not self.swapped:
            return name
        others = ", ".join(flat(arg) for arg in extras)
        a, b = names_for_two(f"{name} {others} {self.selection}")
        first, second = (f"{side}{self.selection}" for side in self.ordered(a, b))
        return f"lambda {a}, {b}: {name}({first}, {second}{', ' + others if others else ''})"
