"""Find the purpose of a backward pass from the optimiser that steps after it: of Gaussians, of poses, or none.

An L1 whose gradients update only poses is tracking; one whose gradients are only read, with no step after it, scores.
"""

from __future__ import annotations

import re
from typing import Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import callees, given_to, likely_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import call_name, dotted, walk_expressions, words, words_in
from legs_adapters.lexicon.words import EMBEDDING, MODELS, PLUMBING, POSES
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.steps import has_step, is_backward, is_step, may_step, reads_gradients
from legs_adapters.terms.findings import Evidence

__all__ = ["Purposes"]

_DEPTH = 3
_OPTIMISER = re.compile(r"Adam|SGD|RMSprop|Adagrad|LBFGS|Adadelta", re.I)


class Purposes:
    """Find the purpose of the backward pass of the expressions of one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._known: Dict[Tuple[Function, Tuple[int, ...], int], Optional[Evidence]] = {}

    def purpose(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Optional[Evidence]:
        """Return the evidence that the backward pass of an expression trains no Gaussians; None where it may."""
        known = function, tuple(map(id, function.flow.loops_around(node))), depth
        if known not in self._known:
            self._known[known] = self._purpose(function, node, depth)
        return self._known[known]

    def _purpose(self, function: Function, node: cst.CSTNode, depth: int) -> Optional[Evidence]:
        passes = [call for call in function.flow.calls if is_backward(call)]
        if not passes:
            return self._of_callers(function, depth)
        at = function.place(node).start
        own = next((call for call in passes if function.place(call).end > at), passes[0])
        may_train = self._may_train(function, own, 0, False)
        inner: List[cst.Call] = []  # the backward passes of the innermost loop that has one
        for scope in [*function.flow.loops_around(node), function.body]:
            inside = {id(part) for part in walk_expressions(scope)}
            steps = [call for call in function.flow.calls if id(call) in inside and is_step(call)]
            within = [call for call in passes if id(call) in inside]
            if inner and len(within) > len(inner) and not may_train:
                break  # the step is of the other backward pass
            inner = inner or within
            if steps and within:
                moved = [self._moved(function, step) for step in steps]
                is_other = all(some & (POSES | EMBEDDING) and not some & MODELS for some in moved)
                return Evidence("pose-step", "tracking", [(function, steps[0])]) if is_other else None
        return None if may_train else Evidence("no-step", "scoring", [(function, own)])

    def _of_callers(self, function: Function, depth: int) -> Optional[Evidence]:
        sites = self.training.sites.get(function, []) if depth < _DEPTH else []
        purposes = [self.purpose(caller, call, depth + 1) for caller, call in sites]
        return purposes[0] if len({purpose and purpose.rule for purpose in purposes}) == 1 else None

    def _may_train(self, function: Function, call: cst.Call, depth: int, read: bool) -> bool:
        """Return whether a step may follow a call, in its function or then in the callers.

        None does where gradients are read and then reset, or where the script, or a function that reads them, ends.
        """
        at = function.place(call).start
        read = read or reads_gradients(function)
        for later in sorted(function.flow.calls, key=lambda each: function.place(each).start):
            if function.place(later).start > at:
                name, called = call_name(later), callees(self.program, function, later)
                called = called or (self.program.methods_named(name) if name else [])  # one of them may run
                if may_step([later]) or any(map(has_step, called)):
                    return True
                read = read or any(map(reads_gradients, called))
                if name == "zero_grad":
                    return not read
        if may_step(function.flow.calls):
            return True  # of the loop's next round
        if function.parent is None or (read and not depth):
            return False
        sites = list(likely_calls(self.program, function)) if depth < _DEPTH else []
        return not sites or any(self._may_train(caller, site, depth + 1, read) for caller, site in sites)

    def _moved(self, function: Function, step: cst.Call) -> Set[str]:
        """Return the words in an optimiser's name, and in the parameters that it was made with."""
        assert isinstance(step.func, cst.Attribute)
        optimiser = step.func.value
        name = set(words(optimiser.attr.value)) if isinstance(optimiser, cst.Attribute) else set()
        found = name if name & POSES else words_in(optimiser)  # gaussians.optimizer_cam moves cameras
        definitions = self.program.lookup(function, optimiser)
        owner = self.program.owner_of(function)
        if not definitions and owner is not None and isinstance(optimiser, cst.Attribute):
            definitions = owner.stores(optimiser.attr.value) if dotted(optimiser.value) == "self" else None
        for where, definition in definitions or ():
            made = definition.value
            if definition.kind == "parameter":
                given = [value for _, value in given_to(self.program, where, definition.place) if value is not None]
                found |= words_in(*given)
            if isinstance(made, cst.Call) and _OPTIMISER.search(call_name(made)) and made.args:
                found |= words_in(made.args[0].value)
        return found - PLUMBING
