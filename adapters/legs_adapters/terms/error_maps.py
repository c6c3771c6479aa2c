"""Error maps with other uses than the loss: ``error = torch.abs(image - gt)`` that also makes a mask."""

from __future__ import annotations

from typing import List, NamedTuple, Set

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import attribute_chain, call_name, walk_expressions
from legs_adapters.lexicon.masks import makes_mask
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.gradients import under_no_grad
from legs_adapters.tensors.operations import EXTREMES, LEAVES, SIZES
from legs_adapters.terms.form import Form

__all__ = ["Reads", "is_asked", "is_measured", "reads_of"]


class Reads(NamedTuple):
    """The reads of a named error map that are the loss, and the others: a mask or a threshold is made of them."""

    loss: List[cst.Name]
    others: List[cst.Name]


def reads_of(training: Training, function: Function, form: Form) -> Reads:
    """Return the reads of a named error map, logging and sizes aside; none where the map has no name of its own."""
    made = [d for d in function.flow.every_definition if d.kind == "assign" and d.value is form.node]
    if not form.is_map or not made or "." in made[0].place:
        return Reads([], [])
    reads = [read for read in function.flow.reads if made[0] in function.flow.reaching(read)]
    unused = {id(part) for call in function.flow.calls if call_name(call) in LEAVES for part in attribute_chain(call)}
    changed = [d.node.target for d in function.flow.every_definition if isinstance(d.node, cst.AugAssign)]
    unused |= {id(part) for target in changed for part in attribute_chain(target)}
    masks: Set[int] = set()
    ranges: Set[int] = set()
    squared: Set[int] = set()  # or compared: a weight would move a threshold
    for part in walk_expressions(function.body):
        if isinstance(part, cst.Attribute) and part.attr.value in SIZES:
            unused.add(id(part.value))
        elif isinstance(part, cst.Comparison) or (
            isinstance(part, cst.BinaryOperation) and isinstance(part.operator, cst.Power)
        ):
            squared.add(id(part.left))
        elif isinstance(part, cst.Call) and call_name(part) in EXTREMES and not part.args:
            ranges |= {id(node) for node in attribute_chain(part.func)}
        elif isinstance(part, cst.Call) and makes_mask(part):
            masks |= {
                id(node) for given in (part.func, *(arg.value for arg in part.args)) for node in attribute_chain(given)
            }
    reads = [read for read in reads if id(read) not in unused and not under_no_grad(function, read)]
    loss = [read for read in reads if training.includes(read) and id(read) not in masks]
    if any(id(read) in ranges for read in reads):
        loss = []  # it is only scaled to 0..1
    if any(id(read) in squared for read in reads):
        return Reads(loss, reads)
    return Reads(loss, [read for read in reads if read not in loss])


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
