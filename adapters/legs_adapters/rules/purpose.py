"""Find the purpose of a backward pass from the optimiser that steps after it: of Gaussians, poses, an embedding, none.

An L1 whose gradients update only a pose is tracking; one that updates only an embedding fits a view for evaluation; one
whose gradients are read and discarded scores Gaussians. Everything else is training.
"""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import likely_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import attribute_chain, call_name, walk_all, words
from legs_adapters.lexicon.optimised import Optimised
from legs_adapters.lexicon.words import EMBEDDINGS, GAUSSIANS, MODELS, POSES
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.operations import OPTIMISERS
from legs_adapters.tensors.steps import (
    calls_in,
    gradients_read,
    has_step,
    is_backward,
    is_step,
    may_step,
    only_reads_gradients,
)

__all__ = ["Purpose", "Purposes"]

_DEPTH = 3


class Purpose(NamedTuple):
    """The purpose of a backward pass that does not train: "tracking", "evaluation" or "scoring"; with the evidence.

    Attributes:
        word: the purpose.
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
        self._optimised = Optimised(program)
        self._known: Dict[Tuple[Function, Tuple[int, ...], int], Optional[Purpose]] = {}

    def purpose(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Optional[Purpose]:
        """Return the purpose of an expression that does not train, by the loops around it; None where it may."""
        loops = function.loops_around(node)
        known = function, tuple(map(id, loops)), depth
        if known not in self._known:
            self._known[known] = self._purpose(function, node, loops, depth)
        return self._known[known]

    def _purpose(
        self, function: Function, node: cst.CSTNode, loops: Sequence[cst.CSTNode], depth: int
    ) -> Optional[Purpose]:
        calls = {id(call): call for call in function.flow.calls}
        passes = [call for call in function.flow.calls if is_backward(call)]
        if not passes:
            return self._of_callers(function, depth)
        scopes = [*loops, function.body]
        stepped = False
        for scope in scopes:
            inside = list(calls_in(scope, node, calls))
            stepped = stepped or any(is_step(call) for call, _ in inside)
            if not any(is_backward(call) for call, _ in inside):
                continue
            optimisers = [call for call, elsewhere in inside if is_step(call) and not elsewhere]
            if optimisers:
                spoken = [self._optimised.words(function, call) for call in optimisers]
                for word, moved in (("tracking", POSES), ("evaluation", EMBEDDINGS)):
                    if all(some & moved and not some & MODELS for some in spoken):
                        return Purpose(word, function, optimisers[0])
                return None
            here = {id(call) for call, _ in inside}
            if self._is_stepped_later(function, node, here, calls):
                continue
            asked = [call for call in function.flow.calls if id(call) in here]
            for_good = self._nobody_steps(function, 0)
            if (
                only_reads_gradients(scope, asked, for_good)
                or (for_good and self._read_by_callers(function))
                or self._emptied_by_callers(function)
                or self._reads_its_own(function, scope)
            ):
                return Purpose("scoring", function, next(call for call in asked if is_backward(call)))
        # At a module's top level no caller can take the step.
        return Purpose("scoring", function, passes[0]) if stepped or function.parent is None else None

    @staticmethod
    def _is_stepped_later(function: Function, node: cst.CSTNode, here: Set[int], calls: Dict[int, cst.Call]) -> bool:
        """Return whether a loop further out has a step, and no backward pass but these: one of a batch of views."""
        around = list(calls_in(function.body, node, calls))
        other = [call for call, elsewhere in around if is_backward(call) and not elsewhere and id(call) not in here]
        return not other and any(is_step(call) and not elsewhere for call, elsewhere in around)

    def _nobody_steps(self, function: Function, depth: int) -> bool:
        """Return whether neither a function nor its known callers can step an optimiser."""
        if may_step(function.flow.calls):
            return False
        if function.parent is None:
            return True
        callers = self._callers(function)
        return bool(callers) and depth < _DEPTH and all(self._nobody_steps(c, depth + 1) for c in callers)

    def _callers(self, function: Function) -> List[Function]:
        return list(dict.fromkeys(caller for caller, _ in likely_calls(self.program, function)))

    def _emptied_by_callers(self, function: Function) -> bool:
        """Return whether each caller reads the gradients, and resets them, before an optimiser can step."""
        calls = list(likely_calls(self.program, function))
        return bool(calls) and all(self._is_emptied_after(caller, call) for caller, call in calls)

    def _is_emptied_after(self, caller: Function, call: cst.Call) -> bool:
        """Return whether gradients are read, then reset, after a call: ``prune()``, then ``zero_grad()``."""
        at = caller.place(call).last_line
        after = sorted((caller.place(other).line, i) for i, other in enumerate(caller.flow.calls))
        read = False
        for line, i in after:
            later = caller.flow.calls[i]
            if line <= at:
                continue
            if call_name(later) == "zero_grad":
                return read
            called = [r.target for r in self.program.resolve(caller, later.func) if isinstance(r.target, Function)]
            if may_step([later]) or any(map(has_step, called)):
                return False
            read = read or any("grad" in each.text and gradients_read(list(walk_all(each.body))) for each in called)
        return False

    def _read_by_callers(self, function: Function) -> bool:
        """Return whether a caller also reads gradients: ``accumulate(scene)``, then ``gaussians.prune(count)``."""
        called = self._called(function, *self._callers(function))
        read = any("grad" in each.text and gradients_read(list(walk_all(each.body))) for each in called)
        return read and not any(map(has_step, called))

    def _called(self, *functions: Function) -> List[Function]:
        """Return the callees of functions: one may step under any name, ``gaussians.post_backward()``."""
        called = [
            reference.target
            for function in functions
            for call in function.flow.calls
            for reference in self.program.resolve(function, call.func)
        ]
        return [each for each in called if isinstance(each, Function)]

    def _reads_its_own(self, function: Function, scope: cst.CSTNode) -> bool:
        """Return whether the gradients that are read are of local models, which no other function can update."""
        roots = [list(attribute_chain(part))[-1] for part in gradients_read(list(walk_all(scope)))]
        names = [root for root in roots if isinstance(root, cst.Name)]
        given = {
            part.value for value in function.flow.returns for part in walk_all(value) if isinstance(part, cst.Name)
        }
        own = bool(roots) and len(names) == len(roots) and not given & {name.value for name in names}
        own = own and all(self._made_here(function, name) for name in names)
        return own and not any(map(has_step, self._called(function)))

    def trains_its_own(self, function: Function) -> bool:
        """Return whether it makes a Gaussian model and steps that model's optimiser: it trains, in any file."""
        steps = [call.func for call in function.flow.calls if is_step(call)]
        stepped = [step.value for step in steps if isinstance(step, cst.Attribute)]
        return any(
            isinstance(optimiser, cst.Attribute)
            and optimiser.attr.value in OPTIMISERS
            and isinstance(optimiser.value, cst.Name)
            and self._made_here(function, optimiser.value)
            for optimiser in stepped
        )

    def _made_here(self, function: Function, model: cst.Name) -> bool:
        """Return whether a model is created here, ``gaussians = GaussianModel(3)``."""
        made = [definition.value for definition in function.flow.reaching(model) if definition.kind != "store"]
        return bool(made) and all(isinstance(v, cst.Call) and set(words(call_name(v))) & GAUSSIANS for v in made)

    def _of_callers(self, function: Function, depth: int) -> Optional[Purpose]:
        sites = self.training.sites.get(function, [])
        if not sites or depth >= _DEPTH:
            return None
        purposes = [self.purpose(caller, call, depth + 1) for caller, call in sites]
        return purposes[0] if len({purpose and purpose.word for purpose in purposes}) == 1 else None
