"""Find what an optimiser updates, in the field's words: Gaussians, camera poses, an embedding."""

from __future__ import annotations

import re
from typing import Iterator, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import given_to
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    call_name,
    children,
    constant,
    dotted,
    same,
    words,
    words_in,
    words_under,
)
from legs_adapters.lexicon.words import GAUSSIANS, PLUMBING, POSES
from legs_adapters.tensors.operations import OPTIMISERS

__all__ = ["Optimised"]

_OPTIMISER = re.compile(r"Adam|SGD|RMSprop|Adagrad|LBFGS|Adadelta", re.I)
_NOTHING = object()
_DEPTH = 3


class Optimised:
    """Find the words for the parameters of the optimisers of one program."""

    def __init__(self, program: Program) -> None:
        self.program = program

    def words(self, function: Function, step: cst.Call) -> Set[str]:
        """Return the words in an optimiser's name, and in its definition."""
        assert isinstance(step.func, cst.Attribute)
        parts: List[cst.CSTNode] = [step.func.value, *(arg.value for arg in step.args)]
        return {word for part in parts for word in self._words_of(function, part, 0)} - PLUMBING

    def _words_of(self, function: Function, node: cst.CSTNode, depth: int) -> Set[str]:
        name = set(words(node.attr.value)) if isinstance(node, cst.Attribute) else set()
        found = name if name & POSES else words_under(node)  # gaussians.optimizer_cam moves cameras
        handed = self._handed_in(function, node)
        if handed is not None:
            return handed
        for where, definition in self.program.lookup(function, node) or self._stored(function, node):
            made = definition.value
            if definition.kind == "parameter" and depth < _DEPTH:
                for caller, given in given_to(self.program, where, definition.place):
                    found |= self._words_of(caller, given, depth + 1) if given is not None else set()
            if definition.kind != "assign" or not isinstance(made, cst.Call):
                continue
            if set(words(call_name(made))) & OPTIMISERS:
                found |= _handed_to(made)
            if not _OPTIMISER.search(call_name(made)):
                continue
            for arg in made.args:
                found |= self._given(where, arg.value)
        return found

    def _stored(self, function: Function, node: cst.CSTNode) -> List[Tuple[Function, Definition]]:
        """Return what the methods of its class store in ``self.optimizer``."""
        owner = self.program.owner_of(function)
        if owner is None or not isinstance(node, cst.Attribute) or dotted(node.value) != "self":
            return []
        return owner.stores(node.attr.value)

    def _handed_in(self, function: Function, node: cst.CSTNode) -> Optional[Set[str]]:
        """Return the words in the parameters that ``model.setup(pose)`` optimises, if none of them is the model's."""
        if not isinstance(node, cst.Attribute):
            return None
        place = f"self.{node.attr.value}"
        found: Set[str] = set()
        for call in function.flow.calls:
            if not isinstance(call.func, cst.Attribute) or not same(call.func.value, node.value):
                continue
            for reference in self.program.resolve(function, call.func):
                method = reference.target
                if not isinstance(method, Function):
                    continue
                for made in method.flow.definitions.get(place, []):
                    if not isinstance(made.value, cst.Call) or not _OPTIMISER.search(call_name(made.value)):
                        continue
                    moved = [word for arg in made.value.args for word in self._given(method, arg.value)]
                    if "self" in moved:
                        return None
                    found.update(moved)
        return found - GAUSSIANS if found & POSES else None

    def _given(self, where: Function, node: cst.CSTNode) -> Set[str]:
        """Return the words in an argument of an optimiser, and in what is appended to a list that it names."""
        found = self._moved(where, node)
        if isinstance(node, cst.Name):  # opt_params = [], then opt_params.append(...)
            for other in where.flow.definitions.get(node.value, []):
                if other.kind == "mutate" or isinstance(other.value, cst.List):
                    assert other.value is not None
                    found |= self._moved(where, other.value)
        return found

    def _moved(self, where: Function, node: cst.CSTNode) -> Set[str]:
        """Return the words in the parameters of an optimiser; for ``model._rot`` of a pose class the class's."""
        found: Set[str] = set()
        held: Set[str] = set()
        for part in _learning(node):
            if isinstance(part, cst.Attribute) and isinstance(part.value, cst.Name):
                for reference in self.program.resolve(where, part.value):
                    spoken = set(words(getattr(reference.target, "name", "")))
                    if reference.kind == "instance" and spoken & POSES:
                        found |= spoken & POSES
                        held |= set(words(part.value.value))
        return found | (words_in(_learning(node)) - held)


def _handed_to(call: cst.Call) -> Set[str]:
    """Return the words in the arguments of ``setup_optimizer(config, cams=[camera])``, without settings."""
    found: Set[str] = set()
    for arg in call.args:
        if constant(arg.value, _NOTHING) is _NOTHING:
            found |= words_under(arg.value) | set(words(arg.keyword.value) if arg.keyword is not None else ())
    return found


def _learning(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """Yield the parameters of an optimiser, without groups of rate 0, ``{"params": [xyz], "lr": 0.0}``.

    For ``camera.parameters()`` that is the camera.
    """
    if isinstance(node, cst.Attribute) and node.attr.value in ("parameters", "named_parameters"):
        yield from _learning(node.value)
    elif not (isinstance(node, cst.Dict) and _stays(node)):
        yield node
        for child in children(node):
            yield from _learning(child)


def _stays(group: cst.Dict) -> bool:
    entries = [entry for entry in group.elements if isinstance(entry, cst.DictElement)]
    return any(constant(entry.key) == "lr" and constant(entry.value) == 0 for entry in entries)
