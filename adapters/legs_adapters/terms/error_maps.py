"""Error maps with other uses than the loss: ``error = torch.abs(image - gt)`` that also makes a mask."""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, attribute_chain, call_name, walk_expressions
from legs_adapters.lexicon.masks import makes_mask
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.gradients import under_no_grad
from legs_adapters.tensors.operations import ENDS_GRADIENT, EXTREMES, LEAVES, SIZES
from legs_adapters.terms.form import Form

__all__ = ["Shared", "is_asked", "is_huber", "is_measured", "is_rescaled", "shared_of", "takes_no_gradient"]


class Shared(NamedTuple):
    """The reads of an error map: the one to weight in its place, and those that keep the plain map.

    ``trains`` is False where none of the reads is the loss.
    """

    loss: List[cst.Name]
    aside: List[cst.Name]
    trains: bool = True


def shared_of(training: Training, function: Function, form: Form) -> Optional[Shared]:
    """Return which reads of a named error map are the loss, and which are not.

    None where the loss (and logging) is its only use.
    """
    made = [
        definition
        for definition in function.flow.every_definition
        if definition.kind == "assign" and definition.value is form.node and "." not in definition.place
    ]
    if not form.is_map or not made:
        return None
    reads = [read for read in function.flow.reads if made[0] in function.flow.reaching(read)]
    callers = {id(arg.value): call for call in function.flow.calls for arg in call.args}
    masks = [
        read for read in reads if id(read) in callers and takes_no_gradient(training, function, callers[id(read)], read)
    ]
    loss = [read for read in reads if training.includes(read) and read not in masks]
    logged = {id(part) for call in function.flow.calls if call_name(call) in LEAVES for part in attribute_chain(call)}
    edited = _edited(function)
    aside = [
        read
        for read in reads
        if read not in loss
        and id(read) not in logged | edited | _asked_for_size(function)
        and not under_no_grad(function, read)
    ]
    if not aside:
        return None
    if not loss:
        return Shared([], [], False)
    if any(id(read) in edited for read in reads):
        return Shared([], [])  # error[mask] *= 2: a new map in the loss's place would lack the change
    alone = [read for read in reads if function.flow.reaching(read) == {made[0]}]  # no other branch made it
    again = loss if len(loss) == 1 and loss[0] in alone and function.flow.unchanged(form.first, form.second) else []
    known = all(
        read in alone and id(read) in callers and function.flow.unchanged_at(callers[id(read)], form.first, form.second)
        for read in aside
    )
    return Shared(again, aside if known else [])


def is_huber(training: Training, function: Function, form: Form) -> bool:
    """Return whether an error is squared below a threshold: ``where(error < d, error ** 2 / 2, d * (error - d / 2))``.

    A mean that is squared for logging, ``torch.log10(1 / torch.sqrt(loss ** 2))``, does not count.
    """

    def reads_it(nodes: List[cst.CSTNode]) -> bool:
        return any(node is form.node or form.node in _values(function, node) for node in nodes)

    for node in function.flow.expressions if not form.is_mean else ():
        if isinstance(node, cst.Call) and call_name(node) == "where":
            parts = [part for arg in node.args for part in walk_expressions(arg.value)]
            named = [value for part in parts if isinstance(part, cst.Name) for value in _values(function, part)]
            parts += [part for value in named if value is not None for part in walk_expressions(value)]
            if any(_squared(part) is not None for part in parts) and reads_it(parts):
                return True
        base = _squared(node)
        if base is not None and training.includes(node) and reads_it(list(walk_expressions(base))):
            return True
    return False


def is_rescaled(function: Function, form: Form) -> bool:
    """Return whether a map is only scaled to 0..1, ``(e - e.min()) / (e.max() - e.min())``, for a threshold."""
    reads = [read for read in function.flow.reads if form.node in _values(function, read)]
    ranges = {id(part) for node in function.flow.expressions for part in _of_range(node)}
    extremes = [call for call in function.flow.calls if call_name(call) in EXTREMES and not call.args]
    asked = {id(call.func.value): call_name(call) for call in extremes if isinstance(call.func, cst.Attribute)}
    used = {asked.get(id(read), "range" if id(read) in ranges else "more") for read in reads}
    return used == {"min", "max", "range"}


def _of_range(node: cst.CSTNode) -> List[cst.CSTNode]:
    """Return ``x`` of ``(x - low) / (high - low)``."""
    if not isinstance(node, cst.BinaryOperation) or not isinstance(node.operator, cst.Divide):
        return []
    parts = [part for part in (node.left, node.right) if isinstance(part, cst.BinaryOperation)]
    both = len(parts) == 2 and all(isinstance(part.operator, cst.Subtract) for part in parts)
    return [parts[0].left] if both else []


def is_measured(function: Function, form: Form) -> bool:
    """Return whether a term is converted to a number, ``error.mean().item()``, which has no gradient."""
    return any(
        call_name(call) in LEAVES and any(part is form.node for part in attribute_chain(call))
        for call in function.flow.calls
    )


def is_asked(function: Function, form: Form) -> bool:
    """Return whether a term is only compared with something, ``while abs(height - wanted) > 0.1``."""
    parts = walk_expressions(function.body)
    return any(isinstance(part, cst.Comparison) and part.left is form.node for part in parts)


def _squared(node: cst.CSTNode) -> Optional[cst.CSTNode]:
    """Return ``x`` of ``x ** 2`` or ``x.square()``."""
    if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Power):
        return node.left
    return node.func if isinstance(node, cst.Call) and call_name(node) in ("square", "pow") else None


def _values(function: Function, node: cst.CSTNode) -> List[Optional[cst.CSTNode]]:
    return [definition.value for definition in function.flow.reaching(node)]


def _edited(function: Function) -> Set[int]:
    """Return the ids of the names whose tensors are changed in place: ``error[mask] *= 2``, ``error.mul_(2)``."""
    changes = function.flow.every_definition
    changed: List[cst.CSTNode] = [d.node.target for d in changes if isinstance(d.node, cst.AugAssign)]
    changed += [d.value for d in changes if d.kind == "inplace" and d.value is not None]
    return {id(part) for node in changed for part in attribute_chain(node)}


def _asked_for_size(function: Function) -> Set[int]:
    """Return the ids of the names of which only the size is read: ``error.shape``, ``error.dim()``."""
    parts = [part for part in walk_expressions(function.body) if isinstance(part, cst.Attribute)]
    return {id(part.value) for part in parts if part.attr.value in SIZES}


def takes_no_gradient(training: Training, function: Function, call: cst.Call, given: cst.CSTNode) -> bool:
    """Return whether a call makes a mask of an error, or uses it without a gradient: ``normalise(error).detach()``."""
    return makes_mask(call) or _only_measured(training, function, call, given)


def _only_measured(training: Training, function: Function, call: cst.Call, given: cst.CSTNode) -> bool:
    references = training.program.resolve(function, call.func)
    if not references or not all(isinstance(r.target, Function) and not r.guess for r in references):
        return False
    for reference in references:
        callee = reference.target
        assert isinstance(callee, Function)
        positional, keywords, _ = arguments(call)
        position = next((i for i, value in enumerate(positional) if value is given), None)
        names = [name for name, value in keywords.items() if value is given]
        if position is not None and position < len(callee.parameters):
            names.append(callee.parameters[position])
        silent: Set[int] = set()
        for inner in callee.flow.calls:
            if call_name(inner) in ENDS_GRADIENT and isinstance(inner.func, cst.Attribute):
                silent.update(id(part) for part in walk_expressions(inner.func.value))
        uses = [
            use
            for use in callee.flow.reads
            if any(d.kind == "parameter" and d.place in names for d in callee.flow.reaching(use))
        ]
        if not uses or not all(id(use) in silent or under_no_grad(callee, use) for use in uses):
            return False
    return True
