"""Definitions of places, and which of them reach one point of a function.

``losses["im"]`` and ``self.x`` are separate places that also belong to the whole (``losses``, ``self``);
``losses.append(x)`` adds to the whole.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import Callable, ClassVar, Dict, Iterator, List, Optional, Sequence, Set


class Reaching:
    """The definitions that reach a point: one, or a join of those that reach the points before it.

    Joins refer to one another, as the phi nodes of SSA do: what is asked of each of them once takes as long as there
    are joins, while n branches have n * n definitions.

    Args:
        parts: what was joined; empty where nothing reaches the point.
    """

    def __init__(self, parts: Sequence[Reaching] = ()) -> None:
        self.parts: Sequence[Reaching] = parts

    def __bool__(self) -> bool:
        return bool(self.parts)

    def __iter__(self) -> Iterator[Definition]:
        """Yield every definition once, in source order."""
        return iter(sorted(self.new(set()), key=lambda made: made.order))

    def new(self, met: Set[Reaching]) -> Iterator[Definition]:
        """Yield the definitions that were not met before, in any order, and add what is met now."""
        work: List[Reaching] = [self]
        while work:
            part = work.pop()
            if part not in met:
                met.add(part)
                work += part.parts
                if isinstance(part, Definition):
                    yield part

    def join(self, other: Optional[Reaching]) -> Reaching:
        """Return both; itself or the other where that was made of both."""
        if other is None or other is self or other in self.parts:
            return self
        return other if self in other.parts else Reaching((other, self))

    def joins(self, is_done: Callable[[Reaching], bool]) -> Iterator[Reaching]:
        """Yield the joins in it and itself, each after those in it; the caller does each before it takes the next."""
        work = [self] if self.parts else []
        while work:
            inner = [part for part in work[-1].parts if part.parts and not is_done(part)]
            work += inner
            if not inner:
                join = work.pop()
                if not is_done(join):
                    yield join


@dataclass(eq=False)
class Definition(Reaching):
    """One definition of a place, which reaches a point alone.

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
    node: ast.AST
    value: Optional[ast.AST] = None
    index: Optional[int] = None
    key: object = None
    order: int = 0
    parts: ClassVar[Sequence[Reaching]] = ()  # type: ignore[misc]

    def __bool__(self) -> bool:
        return True


class Env(Dict[str, Reaching]):
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
                    if joined.get(place) is not definitions:
                        joined[place] = definitions.join(joined.get(place))
            self.clear()
            self.update(joined)
