"""Definitions of places, and which of them reach one point of a function.

``losses["im"]`` and ``self.x`` are separate places that also belong to the whole (``losses``, ``self``);
``losses.append(x)`` adds to the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Dict, FrozenSet, Optional

import libcst as cst

__all__ = ["Definition", "Env"]


@dataclass(eq=False)
class Definition:
    """One definition of a place.

    Attributes:
        place: ``x``, ``self.x`` or ``losses['im']``.
        kind: "assign", "augment" (``x += v``), "element" (of a loop, or of what is unpacked), "part" (of such an
            element that is itself unpacked), "parameter", "import", "function", "class", "mutate"
            (``x.append(v)``), "store" (``x[...] = v``, seen from ``x``), "with", "inplace" (``x.mul_(v)``).
        node: the statement, parameter or expression that did it.
        value: where the value comes from, if that is an expression.
        index: which element of the value, where it is unpacked and known.
        key: for a store under a literal key: the key.
        order: which definition of its function it is, in the order of the source.
    """

    place: str
    kind: str
    node: cst.CSTNode
    value: Optional[cst.CSTNode] = None
    index: Optional[int] = None
    key: object = None
    order: int = 0


class Env(Dict[str, FrozenSet[Definition]]):
    """The definitions of each place that reach one point; it is not alive after a return."""

    alive: bool = True

    def join(self, *ends: Env) -> None:
        """Continue with the definitions at the ends of several branches, of those that go on."""
        alive = [end for end in ends if end.alive]
        self.alive = bool(alive)
        if alive:
            joined = dict(alive[0])
            for end in alive[1:]:
                for place, definitions in end.items():
                    known = joined.get(place)
                    if known is not definitions:
                        joined[place] = definitions if known is None else known | definitions
            self.clear()
            self.update(joined)
