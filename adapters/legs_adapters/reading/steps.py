"""What a backward pass is for, going by the optimisers that step after it: the Gaussians, a camera's pose, or nothing.

An L1 whose gradients move a pose alone is tracking; one that moves an embedding alone fits a view for evaluation; one
whose gradients are read and thrown away scores Gaussians. Only where something else moves is it training.
"""

from __future__ import annotations

import re
from typing import Dict, Iterable, Iterator, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.calls import likely_calls
from legs_adapters.reading.flow import Definition
from legs_adapters.reading.module import Function
from legs_adapters.reading.program import Program
from legs_adapters.reading.syntax import (
    attribute_chain,
    call_name,
    children,
    constant,
    dotted,
    loops_around,
    same,
    word_set,
    words,
)
from legs_adapters.reading.training import Training

__all__ = ["Steps"]

_POSE = word_set("pose poses cam cams camera cameras c2w w2c extrinsic extrinsics camtoworld camtoworlds tracking se3")
_EMBEDDING = word_set("embedding embeddings embed emb appearance exposure")
_MODEL = word_set(
    """
    gaussian gaussians gs splat splats xyz means opacity opacities scaling scalings scales features sh0 shn model models
    net network mlp scene deform anchor anchors primitives points parameters params variables
    """
)
_SCHEDULES = word_set("sched scheduler schedulers lr strategy profiler progress pbar tqdm bar")
_PLUMBING = word_set("torch optim adam params lr name eps self")
_OPTIMISER = re.compile(r"Adam|SGD|RMSprop|Adagrad|LBFGS|Adadelta", re.I)
_MAKES = {"optimizer", "optimiser", "optimizers", "optimisers"}
_STEPS = word_set("step steps update optimize optimise optim adam sgd")
_SCENE = word_set("gaussian gaussians gs splat splats")
_NOTHING = object()
_DEPTH = 3


class Steps:
    """Answers for one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training

    def purpose(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Optional[str]:
        """Return "tracking", "evaluation" or "scoring" for an expression that does not train; None where it may."""
        calls = {id(call): call for call in function.flow.calls}
        if not any(_is_backward(call) for call in calls.values()):
            return self._of_callers(function, depth)
        scopes = [*loops_around(function.body, node), function.body]
        stepped = False
        for scope in scopes:
            inside = list(_calls(scope, node, calls))
            stepped = stepped or any(_is_step(call) for call, _ in inside)
            if not any(_is_backward(call) for call, _ in inside):
                continue
            optimisers = [call for call, elsewhere in inside if _is_step(call) and not elsewhere]
            if optimisers:
                spoken = [self._words(function, call) for call in optimisers]
                if all(some & _POSE and not some & _MODEL for some in spoken):
                    return "tracking"
                if all(some & _EMBEDDING and not some & _MODEL for some in spoken):
                    return "evaluation"
                return None
            here = {id(call) for call, _ in inside}
            if self._is_stepped_later(function, node, here, calls):
                continue
            asked = [call for call in function.flow.calls if id(call) in here]
            for_good = self._nobody_steps(function, 0)
            if _only_reads(scope, asked, for_good) or (for_good and self._read_by_callers(function)):
                return "scoring"
            if self._emptied_by_callers(function):
                return "scoring"
            if self._reads_its_own(function, scope):
                return "scoring"
        # At a module's top nobody else can take the step.
        return "scoring" if stepped or function.parent is None else None

    @staticmethod
    def _is_stepped_later(function: Function, node: cst.CSTNode, here: Set[int], calls: Dict[int, cst.Call]) -> bool:
        """Whether a loop further out has a step, and no backward pass but these: one of a batch of views."""
        around = list(_calls(function.body, node, calls))
        other = [call for call, elsewhere in around if _is_backward(call) and not elsewhere and id(call) not in here]
        return not other and any(_is_step(call) and not elsewhere for call, elsewhere in around)

    def _nobody_steps(self, function: Function, depth: int) -> bool:
        """Whether neither a function nor what calls it, as far as that is known, can step."""
        if _may_step(function.flow.calls):
            return False
        if function.parent is None:
            return True
        callers = self._callers(function)
        return bool(callers) and depth < _DEPTH and all(self._nobody_steps(c, depth + 1) for c in callers)

    def _callers(self, function: Function) -> List[Function]:
        return list(dict.fromkeys(caller for caller, _ in likely_calls(self.program, function)))

    def _emptied_by_callers(self, function: Function) -> bool:
        """Whether each caller has the gradients read, and sets them to nothing, before anything can step."""
        calls = list(likely_calls(self.program, function))
        return bool(calls) and all(self._is_emptied_after(caller, call) for caller, call in calls)

    def _is_emptied_after(self, caller: Function, call: cst.Call) -> bool:
        """``accumulate(scene)``, then ``gaussians.prune(count)``, then ``optimizer.zero_grad()``."""
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
            if _may_step([later]) or any(map(_steps, called)):
                return False
            read = read or any("grad" in each.text and _read(list(_walk(each.body))) for each in called)
        return False

    def _read_by_callers(self, function: Function) -> bool:
        """Whether a caller also calls what reads gradients: ``accumulate(scene)``, then ``gaussians.prune(count)``."""
        called = self._called(function, *self._callers(function))
        read = any("grad" in each.text and _read(list(_walk(each.body))) for each in called)
        return read and not any(map(_steps, called))

    def _called(self, *functions: Function) -> List[Function]:
        """What functions call: a step may stand there under any name, ``gaussians.post_backward()``."""
        called = [
            reference.target
            for function in functions
            for call in function.flow.calls
            for reference in self.program.resolve(function, call.func)
        ]
        return [each for each in called if isinstance(each, Function)]

    def _reads_its_own(self, function: Function, scope: cst.CSTNode) -> bool:
        """Whether the gradients that are read are of models made here, which nobody else gets to step on."""
        roots = [list(attribute_chain(part))[-1] for part in _read(list(_walk(scope)))]
        names = [root for root in roots if isinstance(root, cst.Name)]
        given = {part.value for value in function.flow.returns for part in _walk(value) if isinstance(part, cst.Name)}
        own = bool(roots) and len(names) == len(roots) and not given & {name.value for name in names}
        own = own and all(self._made_here(function, name) for name in names)
        return own and not any(map(_steps, self._called(function)))

    def trains_its_own(self, function: Function) -> bool:
        """Whether it makes a Gaussian model and steps that model's optimiser: training, wherever the file lies."""
        steps = [call.func for call in function.flow.calls if _is_step(call)]
        stepped = [step.value for step in steps if isinstance(step, cst.Attribute)]
        return any(
            isinstance(optimiser, cst.Attribute)
            and optimiser.attr.value in _MAKES
            and isinstance(optimiser.value, cst.Name)
            and self._made_here(function, optimiser.value)
            for optimiser in stepped
        )

    def _made_here(self, function: Function, model: cst.Name) -> bool:
        """``gaussians = GaussianModel(3)``, whatever is stored in it then."""
        made = [definition.value for definition in function.flow.reaching(model) if definition.kind != "store"]
        return bool(made) and all(isinstance(v, cst.Call) and set(words(call_name(v))) & _SCENE for v in made)

    def _of_callers(self, function: Function, depth: int) -> Optional[str]:
        sites = self.training.sites.get(function, [])
        if not sites or depth >= _DEPTH:
            return None
        purposes = {self.purpose(caller, call, depth + 1) for caller, call in sites}
        return purposes.pop() if len(purposes) == 1 else None

    def _words(self, function: Function, step: cst.Call) -> Set[str]:
        """The words in an optimiser's name, and in what it was made of."""
        assert isinstance(step.func, cst.Attribute)
        parts: List[cst.CSTNode] = [step.func.value, *(arg.value for arg in step.args)]
        return {word for part in parts for word in self._words_of(function, part, 0)} - _PLUMBING

    def _words_of(self, function: Function, node: cst.CSTNode, depth: int) -> Set[str]:
        name = set(words(node.attr.value)) if isinstance(node, cst.Attribute) else set()
        found = name if name & _POSE else _spoken(node)  # gaussians.optimizer_cam moves cameras
        handed = self._handed_in(function, node)
        if handed is not None:
            return handed
        for where, definition in self.program.lookup(function, node) or self._stored(function, node):
            made = definition.value
            if definition.kind == "parameter" and depth < _DEPTH:
                for caller in self.program.mentioning(where.name, called=True):
                    for call in caller.flow.calls if caller is not where else ():
                        given = where.given(call, definition.place) if call_name(call) == where.name else None
                        found |= self._words_of(caller, given, depth + 1) if given is not None else set()
            if definition.kind != "assign" or not isinstance(made, cst.Call):
                continue
            if set(words(call_name(made))) & _MAKES:
                found |= _handed_to(made)
            if not _OPTIMISER.search(call_name(made)):
                continue
            for arg in made.args:
                found |= self._given(where, arg.value)
        return found

    def _stored(self, function: Function, node: cst.CSTNode) -> List[Tuple[Function, Definition]]:
        """What the methods of its class store in ``self.optimizer``."""
        owner = self.program.owner_of(function)
        if owner is None or not isinstance(node, cst.Attribute) or dotted(node.value) != "self":
            return []
        return owner.stores(node.attr.value)

    def _handed_in(self, function: Function, node: cst.CSTNode) -> Optional[Set[str]]:
        """The words in what ``model.setup(pose)`` made ``model.optimizer`` of, if of the model's own nothing learns."""
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
        return found - _SCENE if found & _POSE else None

    def _given(self, where: Function, node: cst.CSTNode) -> Set[str]:
        """The words in an argument of an optimiser; of a list with a name also in what is added to it."""
        found = self._moved(where, node)
        if isinstance(node, cst.Name):  # opt_params = [], then opt_params.append(...)
            for other in where.flow.definitions.get(node.value, []):
                if other.kind == "mutate" or isinstance(other.value, cst.List):
                    assert other.value is not None
                    found |= self._moved(where, other.value)
        return found

    def _moved(self, where: Function, node: cst.CSTNode) -> Set[str]:
        """The words in what an optimiser is given; of ``model._rot`` those of the model's class, if it is a pose's."""
        found: Set[str] = set()
        held: Set[str] = set()
        for part in _learning(node):
            if isinstance(part, cst.Attribute) and isinstance(part.value, cst.Name):
                for reference in self.program.resolve(where, part.value):
                    spoken = set(words(getattr(reference.target, "name", "")))
                    if reference.kind == "instance" and spoken & _POSE:
                        found |= spoken & _POSE
                        held |= set(words(part.value.value))
        return found | (_words_in(_learning(node)) - held)


def _handed_to(call: cst.Call) -> Set[str]:
    """The words in what a codebase's own ``setup_optimizer(config, cams=[camera])`` gets; of a setting's name none."""
    found: Set[str] = set()
    for arg in call.args:
        if constant(arg.value, _NOTHING) is _NOTHING:
            found |= _spoken(arg.value) | set(words(arg.keyword.value) if arg.keyword is not None else ())
    return found


def _is_backward(call: cst.Call) -> bool:
    return call_name(call) in ("backward", "manual_backward")


def _is_step(call: cst.Call) -> bool:
    """``gaussians.optimizer.step()``, ``optimizers.optimizer_step_all()``."""
    said = set(words(call_name(call)))
    if not isinstance(call.func, cst.Attribute) or not (said == {"step"} or ("step" in said and said & _MAKES)):
        return False
    return not _is_of_schedule(call)


def _may_step(calls: Iterable[cst.Call]) -> bool:
    """Whether a call says that it steps, under whatever name: ``gaussians.update(opt)``; not ``pbar.update(1)``."""
    return any(set(words(call_name(call))) & _STEPS and not _is_of_schedule(call) for call in calls)


def _is_of_schedule(call: cst.Call) -> bool:
    return isinstance(call.func, cst.Attribute) and bool(_spoken(call.func.value) & _SCHEDULES)


def _steps(function: Function) -> bool:
    """Whether an optimiser steps in it. Its text may be its whole file's, so that only leads to a closer look."""
    return "step" in function.text and any(map(_is_step, function.flow.calls))


def _only_reads(scope: cst.CSTNode, calls: List[cst.Call], for_good: bool) -> bool:
    """Whether the gradients are read after each backward pass, and nothing can have stepped.

    They are set to nothing then; where nobody steps, ``for_good``, they need not be.
    """
    last = max(i for i, call in enumerate(calls) if _is_backward(call))
    if _may_step(calls):
        return False
    parts = list(_walk(scope))
    again = isinstance(scope, (cst.For, cst.While)) and any(_empties(part) for part in parts)
    if not for_good and not again and "zero_grad" not in [call_name(call) for call in calls[last:]]:
        return False
    return bool(_read(parts))


def _read(parts: List[cst.CSTNode]) -> List[cst.Attribute]:
    """The gradients that are read, ``xyz.grad``; none where a step by hand takes one of them."""
    asked = {id(p) for part in parts if _asks(part) for p in _walk(part)}
    taken = {id(p) for part in parts for given in _taken(part) for p in _walk(given)}
    read = [p for p in parts if isinstance(p, cst.Attribute) and p.attr.value == "grad" and id(p) not in asked]
    return [] if any(id(p) in taken for p in read) else read


def _empties(node: cst.CSTNode) -> bool:
    """``xyz.grad = None``: in a loop each pass but the last loses its gradients, wherever in it that stands."""
    if not isinstance(node, cst.Assign) or constant(node.value, _NOTHING) is not None:
        return False
    return any(isinstance(t.target, cst.Attribute) and t.target.attr.value == "grad" for t in node.targets)


def _asks(node: cst.CSTNode) -> bool:
    """``xyz.grad is not None``."""
    return isinstance(node, cst.Comparison) or _empties(node)


def _taken(node: cst.CSTNode) -> List[cst.CSTNode]:
    """What a step by hand takes: ``xyz -= lr * xyz.grad``, ``xyz - xyz.grad``, ``xyz.data.add_(-lr * xyz.grad)``."""
    if isinstance(node, cst.AugAssign):
        return [node.value] if isinstance(node.operator, cst.SubtractAssign) else []
    if isinstance(node, cst.BinaryOperation):  # xyz.grad - other.grad compares the two
        of_grads = any(isinstance(p, cst.Attribute) and p.attr.value == "grad" for p in _walk(node.left))
        return [node.right] if isinstance(node.operator, cst.Subtract) and not of_grads else []
    in_place = isinstance(node, cst.Call) and call_name(node).endswith("_")
    return [child.value for child in children(node) if in_place and isinstance(child, cst.Arg)]


def _learning(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    """Yield the parts of what an optimiser is given, without groups that stay, ``{"params": [xyz], "lr": 0.0}``.

    Of ``camera.parameters()`` that is the camera.
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


def _spoken(node: cst.CSTNode) -> Set[str]:
    return _words_in(_walk(node))


def _words_in(parts: Iterable[cst.CSTNode]) -> Set[str]:
    found: Set[str] = set()
    for part in parts:
        if isinstance(part, cst.Name):
            found.update(words(part.value))
        elif isinstance(part, cst.SimpleString) and isinstance(constant(part), str):
            found.update(words(constant(part)))
    return found


def _calls(scope: cst.CSTNode, node: cst.CSTNode, calls: Dict[int, cst.Call]) -> Iterator[Tuple[cst.Call, bool]]:
    """Yield the calls in a scope; each with whether it belongs to another training loop in it."""
    stack: List[Tuple[cst.CSTNode, bool]] = [(scope, False)]
    while stack:
        part, elsewhere = stack.pop()
        if id(part) in calls:
            yield calls[id(part)], elsewhere
        if part is not scope and isinstance(part, (cst.For, cst.While)) and not elsewhere:
            below = list(_walk(part))
            elsewhere = node not in below and any(isinstance(p, cst.Call) and _is_backward(p) for p in below)
        stack.extend((child, elsewhere) for child in children(part))


def _walk(node: cst.CSTNode) -> Iterator[cst.CSTNode]:
    stack = [node]
    while stack:
        part = stack.pop()
        yield part
        stack.extend(children(part))
