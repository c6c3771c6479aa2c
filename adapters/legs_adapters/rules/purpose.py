"""Find the purpose of a backward pass from the optimiser that steps after it: of Gaussians, poses, an embedding, none.

An L1 whose gradients update only poses is tracking, only an embedding evaluation; one that no optimiser follows scores.
"""

from __future__ import annotations

import re
from typing import Dict, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import given_to, likely_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import call_name, dotted, walk_all, words, words_in
from legs_adapters.lexicon.words import EMBEDDINGS, MODELS, PLUMBING, POSES
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.steps import gradients_read, has_step, is_backward, is_step, may_step

__all__ = ["Purpose", "Purposes"]

_DEPTH = 3
_OPTIMISER = re.compile(r"Adam|SGD|RMSprop|Adagrad|LBFGS|Adadelta", re.I)


class Purpose(NamedTuple):
    """The purpose of a backward pass that does not train the Gaussians: with the evidence.

    Attributes:
        word: the purpose: "tracking", "evaluation" or "scoring".
        function, node: the step of the optimiser, or the backward pass that no step follows.
    """

    word: str
    function: Function
    node: cst.CSTNode


class Purposes:
    """Find the purpose of the backward pass of the expressions of one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._known: Dict[Tuple[Function, Tuple[int, ...], int], Optional[Purpose]] = {}

    def purpose(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Optional[Purpose]:
        """Return the purpose of an expression that does not train, by the loops around it; None where it may."""
        known = function, tuple(map(id, function.flow.loops_around(node))), depth
        if known not in self._known:
            self._known[known] = self._purpose(function, node, depth)
        return self._known[known]

    def _purpose(self, function: Function, node: cst.CSTNode, depth: int) -> Optional[Purpose]:
        passes = [call for call in function.flow.calls if is_backward(call)]
        if not passes:
            return self._of_callers(function, depth)
        at = function.place(node).start
        own = next((call for call in passes if function.place(call).end > at), passes[0])
        follows = self._follows(function, own, 0, False)
        inner: Set[int] = set()  # what the innermost loop with a backward pass calls
        for scope in [*function.flow.loops_around(node), function.body]:
            inside = {id(part) for part in walk_all(scope)}
            calls = [call for call in function.flow.calls if id(call) in inside]
            back = [call for call in calls if is_backward(call)]
            steps = [call for call in calls if is_step(call)]
            if inner and follows == "reset" and any(id(call) not in inner for call in back):
                break  # the step is of the other backward pass
            if back and steps:
                moved = [self._moved(function, step) for step in steps]
                for word, others in (("tracking", POSES), ("evaluation", EMBEDDINGS)):
                    if all(some & others and not some & MODELS for some in moved):
                        return Purpose(word, function, steps[0])
                return None
            inner = inner or ({id(call) for call in calls} if back else inner)
        return Purpose("scoring", function, own) if follows in ("reset", "nothing") else None

    def _of_callers(self, function: Function, depth: int) -> Optional[Purpose]:
        sites = self.training.sites.get(function, [])
        if not sites or depth >= _DEPTH:
            return None
        purposes = [self.purpose(caller, call, depth + 1) for caller, call in sites]
        return purposes[0] if len({purpose and purpose.word for purpose in purposes}) == 1 else None

    def _follows(self, function: Function, call: cst.Call, depth: int, read: bool) -> str:
        """Return what is first after a call, in its function or then in the callers.

        That is "step", a "reset" of gradients that were read, "nothing" at the end of the script, or "unknown".
        """
        at = function.place(call).start
        calls = sorted(function.flow.calls, key=lambda each: function.place(each).start)
        read = read or _reads_gradients(function)
        for later in (each for each in calls if function.place(each).start > at):
            resolved = [r.target for r in self.program.resolve(function, later.func)]
            called = [each for each in resolved if isinstance(each, Function)]
            if may_step([later]) or any(map(has_step, called)):
                return "step"
            read = read or any(map(_reads_gradients, called))
            if call_name(later) == "zero_grad":
                return "reset" if read else "unknown"
        if may_step(calls):
            return "step"  # of the loop's next round
        if function.parent is None:
            return "nothing"
        sites = list(likely_calls(self.program, function)) if depth < _DEPTH else []
        found = {self._follows(caller, site, depth + 1, read) for caller, site in sites}
        return found.pop() if len(found) == 1 else "unknown"

    def _moved(self, function: Function, step: cst.Call) -> Set[str]:
        """Return the words in an optimiser's name, and in the parameters that it was made with."""
        assert isinstance(step.func, cst.Attribute)
        optimiser = step.func.value
        name = set(words(optimiser.attr.value)) if isinstance(optimiser, cst.Attribute) else set()
        found = name if name & POSES else words_in(walk_all(optimiser))  # gaussians.optimizer_cam moves cameras
        owner = self.program.owner_of(function)
        stored = isinstance(optimiser, cst.Attribute) and dotted(optimiser.value) == "self" and owner is not None
        definitions = self.program.lookup(function, optimiser)
        if not definitions and stored and owner is not None and isinstance(optimiser, cst.Attribute):
            definitions = owner.stores(optimiser.attr.value)
        for where, definition in definitions or ():
            made = definition.value
            if definition.kind == "parameter":
                given = [value for _, value in given_to(self.program, where, definition.place) if value is not None]
                found |= words_in(part for value in given for part in walk_all(value))
            if isinstance(made, cst.Call) and _OPTIMISER.search(call_name(made)) and made.args:
                parts = [part for value in _listed(where, made.args[0].value) for part in walk_all(value)]
                found |= words_in(parts) | self._pose_classes(where, parts)
        return found - PLUMBING

    def _pose_classes(self, where: Function, parts: List[cst.CSTNode]) -> Set[str]:
        """Return the words for poses in the classes of what is optimised, ``model._rot`` of a ``PoseModel``."""
        held = [part.value for part in parts if isinstance(part, cst.Attribute) and isinstance(part.value, cst.Name)]
        classes = [r for value in held for r in self.program.resolve(where, value) if r.kind == "instance"]
        return {word for each in classes for word in words(getattr(each.target, "name", ""))} & POSES


def _reads_gradients(function: Function) -> bool:
    return "grad" in function.text and bool(gradients_read(list(walk_all(function.body))))


def _listed(function: Function, node: cst.CSTNode) -> List[cst.CSTNode]:
    """Return an argument of an optimiser, with what is appended to the list that it names."""
    parts = function.flow.definitions.get(node.value, []) if isinstance(node, cst.Name) else []
    kept = [d.value for d in parts if d.kind == "mutate" or isinstance(d.value, cst.List)]
    return [node, *(value for value in kept if value is not None)]
