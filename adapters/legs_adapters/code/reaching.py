"""Reaching definitions: for every place that is read, the assignments that its value can come from.

``losses["im"]`` and ``self.x`` are separate places that also belong to the whole (``losses``, ``self``);
``losses.append(x)`` adds to the whole.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Dict, FrozenSet, List, Optional, Sequence, Set, Tuple

import libcst as cst

from legs_adapters.code.syntax import walk_expressions

__all__ = ["Definition", "Env", "Reaching", "join"]

_PART = re.compile(r"[.\[]")


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


Env = Dict[str, FrozenSet[Definition]]


def join(envs: Sequence[Optional[Env]]) -> Optional[Env]:
    """Join the definitions at the end of several branches; None where no branch continues."""
    alive = [env for env in envs if env is not None]
    if not alive:
        return None
    joined = dict(alive[0])
    for env in alive[1:]:
        for place, definitions in env.items():
            joined[place] = joined[place] | definitions if place in joined else definitions
    return joined


class Reaching:
    """The definitions of one function body, and which of them reach each use.

    Attributes:
        definitions: every definition by place, in source order: what a nested function sees.
    """

    def __init__(self) -> None:
        self.definitions: Dict[str, List[Definition]] = {}
        self._reaching: Dict[int, Set[Definition]] = {}
        self._names: Dict[int, List[Env]] = {}
        self._snapshot: Optional[Tuple[Env, Env]] = None  # an environment, and a copy as it is now
        self._made: Dict[Tuple[int, str, str], Definition] = {}
        self._holders: Set[str] = set()  # places of which a part is defined: ``x`` and ``x.y`` of ``x.y['z']``

    @property
    def every_definition(self) -> List[Definition]:
        """All definitions, place by place."""
        return [definition for definitions in self.definitions.values() for definition in definitions]

    def assigned(self, node: cst.CSTNode) -> List[cst.CSTNode]:
        """Return the values of the assignments that reach this use."""
        return [d.value for d in self.reaching(node) if d.kind == "assign" and d.value is not None]

    def reaching(self, node: cst.CSTNode) -> FrozenSet[Definition]:
        """Return the definitions that this use of a place can come from; empty for what is not local."""
        return frozenset(self._reaching.get(id(node), ()))

    def value_of(self, node: cst.CSTNode) -> Optional[cst.CSTNode]:
        """Return the value of a name, where exactly one assignment reaches it; else None."""
        found = list(self.reaching(node)) if isinstance(node, cst.Name) else []
        return found[0].value if len(found) == 1 and found[0].kind == "assign" else None

    def names_at(self, node: cst.CSTNode, place: str) -> FrozenSet[Definition]:
        """Return the definitions of a place that reach a call or an operation, whether or not it reads it."""
        found: Set[Definition] = set()
        for env in self._names.get(id(node), ()):
            found |= env.get(place, frozenset())
        return frozenset(found)

    def _known(self, made: Definition) -> Definition:
        """Return the definition that a statement was recorded as when it was met first; a loop is walked twice."""
        known = self._made.setdefault((id(made.node), made.place, made.kind), made)
        if known is made:
            made.order = len(self._made)
            self.definitions.setdefault(made.place, []).append(made)
            self._holders.update(made.place[: found.start()] for found in _PART.finditer(made.place))
        return known

    def _bind(self, env: Env, definition: Definition) -> None:
        definition = self._known(definition)
        self._snapshot = None
        place = definition.place
        if place in self._holders:  # a top level may bind thousands of names, and few of them have parts
            for other in [other for other in env if other.startswith((place + ".", place + "["))]:
                del env[other]
        env[place] = frozenset([definition])

    def _add(self, env: Env, definition: Definition) -> None:
        definition = self._known(definition)
        self._snapshot = None
        env[definition.place] = env.get(definition.place, frozenset()) | {definition}

    def unchanged(self, *nodes: cst.CSTNode) -> bool:
        """Return whether the names in expressions are not reassigned anywhere in the body."""
        for part in (part for node in nodes for part in walk_expressions(node)):
            if isinstance(part, cst.Name):
                known = self.reaching(part)
                everywhere = [d for d in self.definitions.get(part.value, []) if d.kind != "store"]
                if known and not set(everywhere) <= known:
                    return False
        return True

    def unchanged_at(self, call: cst.CSTNode, *nodes: cst.CSTNode) -> bool:
        """Return whether the names in expressions have the same definitions at a later call."""
        return all(
            self.names_at(call, part.value) == self.reaching(part)
            for node in nodes
            for part in walk_expressions(node)
            if isinstance(part, cst.Name) and self.reaching(part)
        )
