"""Find the purpose of a backward pass from the optimiser that steps after it: of Gaussians, of poses, or none.

An L1 whose gradients update only poses is tracking; one whose gradients are only read, with no step after it, scores.
"""

from __future__ import annotations

import ast
import itertools
import re
from typing import Any, Callable, Dict, List, Optional, Sequence, Set, Tuple

from legs_adapters.code.calls import callees, given_to, likely_calls, values_of
from legs_adapters.code.limits import remembered
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    call_name,
    constant,
    dotted,
    entries,
    given,
    words,
    words_in,
)
from legs_adapters.lexicon.words import EMBEDDING, GAUSSIANS, MODELS, PLUMBING, POSES, TENSORS
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.steps import has_step, is_backward, is_step, may_step, reads_gradients
from legs_adapters.terms.findings import Evidence

_DEPTH = 3
_Step = Tuple[Function, ast.Call, ast.expr, Set[str]]  # with the optimiser, and the words of whose method runs it
_Value = Tuple[Function, ast.AST]
_STEPS = re.compile(r"step(?:(?!step)\w)*\s*\(")
_CALLED = re.compile(r"\b(\w+)\s*\(")
_OPTIMISER = re.compile(r"Adam|SGD|RMSprop|Adagrad|LBFGS|Adadelta", re.I)


class Purposes:
    """Find the purpose of the backward pass of the expressions of one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._known: Dict[Tuple[str, Function, Tuple[int, ...], int], Any] = {}

    def purpose(self, function: Function, node: ast.AST, depth: int = 0) -> Optional[Evidence]:
        """Return the evidence that the backward pass of an expression trains no Gaussians; None where it may."""
        score = self.training.scores(node)
        if score is not None:
            return Evidence("no-step", "scoring", [score])
        return self._once(self._purpose, function, node, depth)

    def of_call(self, function: Function, node: ast.AST, caller: Function, call: ast.Call) -> Optional[Evidence]:
        """Return the evidence that one call of a function trains no Gaussians: by its step, or optimiser."""
        if not any(map(is_backward, function.flow.calls)):
            return self.purpose(caller, call)
        steps = self._after(function, node)[1]
        given = [(step, function.given(call, step[2].id)) for step in steps if isinstance(step[2], ast.Name)]
        moved = [self._moved((caller, step[1], value, set())) for step, value in given if value is not None]
        is_of_poses = bool(moved) and len(moved) == len(steps) and all(map(_are_poses, moved))
        return Evidence("pose-step", "tracking", [(caller, call)]) if is_of_poses else None

    def moves_gaussians(self, function: Function, node: ast.AST, depth: int = 0) -> bool:
        """Return whether an optimiser that steps after the backward pass of an expression is known to have them."""
        return self._once(self._moves, function, node, depth)

    def _once(self, ask: Callable[..., Any], function: Function, node: ast.AST, depth: int) -> Any:
        """Ask once for the terms of a round of a loop: the step after them is the same."""
        known = ask.__name__, function, tuple(map(id, function.flow.loops_around(node))), depth
        if known not in self._known:
            self._known[known] = ask(function, node, depth)
        return self._known[known]

    def _moves(self, function: Function, node: ast.AST, depth: int) -> bool:
        if not any(map(is_backward, function.flow.calls)):
            sites = self.training.sites.get(function, []) if depth < _DEPTH else []
            return any(self.moves_gaussians(caller, call, depth + 1) for caller, call in sites)
        return any(self._moved(step) & (GAUSSIANS | TENSORS) for step in self._after(function, node)[1])

    def _purpose(self, function: Function, node: ast.AST, depth: int) -> Optional[Evidence]:
        if not any(map(is_backward, function.flow.calls)):
            sites = self.training.sites.get(function, []) if depth < _DEPTH else []
            purposes = [self.purpose(caller, call, depth + 1) for caller, call in sites]
            return purposes[0] if len({purpose and purpose.rule for purpose in purposes}) == 1 else None
        own, steps = self._after(function, node)
        if own is not None:
            return Evidence("no-step", "scoring", [(function, own)])
        is_of_poses = bool(steps) and all(_are_poses(self._moved(step)) for step in steps)
        return Evidence("pose-step", "tracking", [steps[0][:2]]) if is_of_poses else None

    def _after(self, function: Function, node: ast.AST) -> Tuple[Optional[ast.Call], List[_Step]]:
        """Return the steps after the backward pass of an expression; and that pass, where none follows it."""
        passes = [call for call in function.flow.calls if is_backward(call)]
        at = function.place(node).start
        own = next((call for call in passes if function.place(call).end > at), passes[0])
        may_train = self._may_train(function, own, 0, False)
        inner: List[ast.Call] = []  # the backward passes of the innermost loop that has one
        for loop in [*function.flow.loops_around(node), None]:
            calls = [call for call in function.flow.calls if loop is None or loop in function.flow.loops_around(call)]
            within = [call for call in calls if is_backward(call)]
            if inner and len(within) > len(inner) and not may_train:
                break  # the step is of the other backward pass
            inner = inner or within
            calls = calls if within else []
            steps = [step for call in calls for step in self._steps(function, call)]
            if steps:
                return None, steps
        return None if may_train else own, []

    def _steps(self, function: Function, call: ast.Call, depth: int = 0) -> List[_Step]:
        """Return the steps of a call: its own, or those of the functions that it calls and that take no gradient."""
        if isinstance(call.func, ast.Attribute) and is_step(call):
            return [(function, call, call.func.value, set())]
        name = call_name(call)
        if name not in self._stepping() or depth > _DEPTH:
            return []
        found = callees(self.program, function, call)
        if not found and isinstance(call.func, ast.Attribute):
            found = self.program.methods_named(name)  # one of them may run
        steps = [step for each in found for inner in each.flow.calls for step in self._steps(each, inner, depth + 1)]
        runs = words_in(call.func.value) if isinstance(call.func, ast.Attribute) else set()
        return [(where, step, of, said | runs) for where, step, of, said in steps]

    @remembered
    def _stepping(self) -> Set[str]:
        """Return the names of the functions with a step in them, and of those that call one in its file."""
        known: Set[str] = {"step"}
        for module in self.program.matching(_STEPS):
            calls = [(each.name, set(_CALLED.findall(each.text))) for each in module.scopes(bool) if each.name]
            found = {name for name, called in calls if any("step" in each for each in called)}
            while not found <= known:
                known |= found
                found = {name for name, called in calls if called & found}
        return known

    def _may_train(self, function: Function, call: ast.Call, depth: int, read: bool) -> bool:
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

    def _moved(self, step: _Step) -> Set[str]:
        """Return the words in an optimiser's name, and in the parameters that it was made with."""
        function, _, optimiser, said = step
        name = set(words(optimiser.attr)) if isinstance(optimiser, ast.Attribute) else set()
        found = said | (name if name & POSES else words_in(optimiser))  # gaussians.optimizer_cam moves cameras
        for each in self._given(function, optimiser):
            found |= set().union(*(_named_in(leaf) for _, leaf in self._leaves(*each)))
        return found - PLUMBING

    def _given(self, function: Function, optimiser: ast.AST, depth: int = 0) -> List[_Value]:
        """Return what an optimiser was made with, or what is passed for it where that is not known."""
        found: List[_Value] = []
        for where, definition in _definitions(self.program, function, optimiser):
            made = definition.value
            if definition.kind == "parameter" and depth < _DEPTH:
                for caller, value in given_to(self.program, where, definition.place):
                    if value is not None:
                        found += self._given(caller, value, depth + 1) or [(caller, value)]
            values = [(where, made)]
            if definition.kind == "element" and made is not None:  # for each in optimizers.values()
                held = [each for part in attribute_chain(made) for each in _definitions(self.program, where, part)]
                values = [(holder, entry) for holder, each in held for entry in _entries(each.value)]
            known = [self._made_with(*each) for each in values]
            found += itertools.chain(*known) if all(known) else ()
        return found

    def _made_with(self, where: Function, made: Optional[ast.AST]) -> List[_Value]:
        """Return what an optimiser is made with, in a helper too; nothing for what makes none."""
        of = _optimised(made)
        returned = values_of(self.program, where, made) if of is None else []
        inner = [(helper, _optimised(value)) for helper, value in returned]
        passed = [helper.given(made, own.id) for helper, own in inner if isinstance(own, ast.Name)]  # type: ignore[arg-type]
        return [(where, each) for each in [of, *passed] if each is not None]

    def _leaves(self, function: Function, node: ast.AST, depth: int = 0) -> List[_Value]:
        """Return the parameters in ``[{"params": [a, b]}, c]``, or in a name of such a list."""
        inner = self._within(function, node) if depth <= _DEPTH else []
        return [leaf for each in inner for leaf in self._leaves(*each, depth + 1)] if inner else [(function, node)]

    def _within(self, function: Function, node: ast.AST) -> List[_Value]:
        """Return what a list, a group of parameters, or a name of a list has in it; nothing for anything else."""
        found: Sequence[Optional[ast.AST]] = []
        if isinstance(node, (ast.List, ast.Tuple)):
            found = _entries(node)
        elif isinstance(node, ast.Dict):
            found = [value for key, value in entries(node) if constant(key) in ("params", "name")]
        elif isinstance(node, ast.Name):
            values = function.flow.assigned(node)
            lists = [(function, value) for value in values]
            lists += [each for value in values for each in values_of(self.program, function, value)]
            return [each for each in lists if isinstance(each[1], (ast.List, ast.Tuple, ast.Dict))]
        elif isinstance(node, ast.Call) and call_name(node) == "list":
            found = [arg.value for arg in given(node)]
        return [(function, each) for each in found if each is not None]


def _are_poses(moved: Set[str]) -> bool:
    """Return whether what an optimiser moves is poses or embeddings alone, by the words."""
    return bool(moved & (POSES | EMBEDDING)) and not moved & MODELS


def _definitions(program: Program, function: Function, node: ast.AST) -> List[Tuple[Function, Definition]]:
    """Return the definitions of a name, or of what the methods of its class assign to ``self.name``."""
    found, owner = program.lookup(function, node), program.owner_of(function)
    if found is not None:
        return [(found[0], made) for made in found[1]]
    if owner is not None and isinstance(node, ast.Attribute) and dotted(node.value) == "self":
        return owner.stores(node.attr)
    return []


def _optimised(made: Optional[ast.AST]) -> Optional[ast.AST]:
    """Return what an optimiser is made with; None for what makes none."""
    if not isinstance(made, ast.Call) or not _OPTIMISER.search(call_name(made)):
        return None
    positional, keywords, _ = arguments(made)
    return keywords.get("params") or next(iter(positional), None)


def _named_in(leaf: ast.AST) -> Set[str]:
    """Return the words of what is given; of ``[cam.pose for cam in scene.cameras]`` those of the pose."""
    elements = words_in(leaf.elt) - PLUMBING if isinstance(leaf, ast.ListComp) else set()
    return elements if elements & (POSES | EMBEDDING | MODELS) else words_in(leaf)


def _entries(value: Optional[ast.AST]) -> List[Optional[ast.AST]]:
    """Return the values in a dict or a list, or what a comprehension makes one of; else the value itself."""
    if isinstance(value, (ast.List, ast.Tuple)):
        return [each.value if isinstance(each, ast.Starred) else each for each in value.elts]
    if isinstance(value, ast.Dict):
        return list(value.values)
    return [value.elt if isinstance(value, ast.ListComp) else value.value if isinstance(value, ast.DictComp) else value]
