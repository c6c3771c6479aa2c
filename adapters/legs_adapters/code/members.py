"""Resolve members of classes: what an attribute of an instance can be, and which classes derive from which."""

from __future__ import annotations

from typing import Dict, FrozenSet, Iterable, List, Mapping, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.checkout import Checkout
from legs_adapters.code.module import CALLED, Class, Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.sources import Source
from legs_adapters.code.syntax import word_set

__all__ = ["DEPTH", "Conventions", "Members", "Reference", "unique"]

DEPTH = 12  # how many names are followed, one to the next
# Methods whose names are too common to resolve.
_COMMON = word_set("__init__ get items keys values copy load save append update close write read format join split pop")


class Reference(NamedTuple):
    """A function, class, module or library name that an expression refers to.

    ``kind``: "function", "class", "instance" (of a class), "module", "external" (a dotted name outside of the
    checkout), "lambda". ``guess``: found by its name alone.
    """

    kind: str
    target: object
    guess: bool = False


class Conventions(NamedTuple):
    """The conventions by which libraries pass objects on, which the checkout itself does not show.

    Attributes:
        returning_self: methods that return the object itself, ``model.cuda()``.
        wrapping: functions that return their argument wrapped: ``DataParallel(model)``; dotted where the name alone is
            ambiguous.
        common: names of methods that are too common to resolve.
    """

    returning_self: FrozenSet[str] = frozenset()
    wrapping: FrozenSet[str] = frozenset()
    common: FrozenSet[str] = frozenset()


class Members(Checkout):
    """The files of a checkout, and the members of its classes.

    Args:
        sources: the readable files.
        unread: by path, the text of ignored and unreadable files, which is only searched for names.
        conventions: of the libraries that it uses.
    """

    def __init__(
        self,
        sources: Iterable[Source],
        unread: Optional[Mapping[str, str]] = None,
        conventions: Optional[Conventions] = None,
    ) -> None:
        super().__init__(sources, unread)
        self._conventions = conventions or Conventions()
        # by expression and depth; each may be asked from many places, and asks for many others
        self._resolved: Dict[Function, Dict[Tuple[int, int], Tuple[cst.CSTNode, List[Reference]]]] = {}
        self._common = _COMMON | self._conventions.common

    def resolve(self, function: Function, node: cst.CSTNode, depth: int = 0) -> List[Reference]:
        """Return what an expression may refer to; empty where it is unknown."""
        raise NotImplementedError

    def of_definition(self, where: Function, definition: Definition, depth: int = 0) -> List[Reference]:
        """Return what a definition may bind its place to."""
        raise NotImplementedError

    def owner_of(self, function: Function) -> Optional[Class]:
        """Return the class whose ``self`` a function sees."""
        scope: Optional[Function] = function
        while scope is not None:
            if scope.owner is not None:
                return scope.owner
            scope = scope.parent
        return None

    def overrides(self, owner: Class, name: str) -> List[Reference]:
        """Resolve ``self.step()`` in a base class: the methods of classes that derive from it."""
        if name.startswith("__"):
            return []
        found = []
        for method in self.methods_named(name) if name not in self._common else []:
            assert method.owner is not None
            if method.owner is not owner and self._derives(method.owner, owner):
                found.append(Reference("function", method))
        return found

    def _derives(self, derived: Class, owner: Class) -> bool:
        seen: Set[int] = set()
        queue = self.bases(derived)
        while queue:
            current = queue.pop()
            if current is owner:
                return True
            if id(current) not in seen:
                seen.add(id(current))
                queue.extend(self.bases(current))
        return False

    def bases(self, owner: Class) -> List[Class]:
        """Return the base classes that are defined in the checkout."""
        found = []
        for arg in owner.node.bases:
            for ref in self.resolve(owner.parent, arg.value):
                if ref.kind == "class" and isinstance(ref.target, Class) and ref.target is not owner:
                    found.append(ref.target)
        return found

    def member(self, owner: Class, name: str, depth: int = 0) -> List[Reference]:
        """Return what ``instance.name`` may be: a method, or a value that methods of the class store."""
        references: List[Reference] = []
        seen: Set[int] = set()
        queue = [owner]
        while queue and depth <= DEPTH:
            current = queue.pop(0)
            if id(current) in seen:
                continue
            seen.add(id(current))
            if name in current.methods:
                references.append(Reference("function", current.methods[name]))
                break
            if name in current.fields:
                references.extend(self.resolve(current.parent, current.fields[name], depth + 1))
            for method, definition in current.stores(name):
                references.extend(self.of_definition(method, definition, depth + 1))
            queue.extend(self.bases(current))
        return unique(references)

    def run_by(self, reference: Reference) -> List[Function]:
        """Return the functions that a call of a reference runs: itself, or the ``forward`` of an instance."""
        found = [reference]
        if reference.kind == "instance" and isinstance(reference.target, Class):
            found = [ref for name in CALLED for ref in self.member(reference.target, name)]
        return [ref.target for ref in found if ref.kind == "function" and isinstance(ref.target, Function)]


def unique(references: Iterable[Reference]) -> List[Reference]:
    """Return each reference once, in their order."""
    found: Dict[Tuple[str, object], Reference] = {}
    for ref in references:
        key = (ref.kind, ref.target if isinstance(ref.target, str) else id(ref.target))
        found.setdefault(key, ref)
    return list(found.values())
