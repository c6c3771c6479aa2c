"""Error maps with other uses than the loss: ``error = torch.abs(image - gt)`` that also makes a mask."""

from __future__ import annotations

from typing import List, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import attribute_chain, call_name, walk_expressions
from legs_adapters.lexicon.masks import makes_mask
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.gradients import no_grad_around
from legs_adapters.tensors.operations import EXTREMES, LEAVES, SIZES, TRANSFORMS
from legs_adapters.terms.form import Form

__all__ = ["is_measured", "reads_of"]


def reads_of(training: Training, function: Function, form: Form) -> Tuple[List[cst.Name], List[cst.Name]]:
    """Return the reads of a named error map, logging and sizes aside; none where the map has no name of its own.

    Returns:
        The reads that are the loss, and the others: a mask or a threshold is made of them.
    """
    named = [d for d in function.flow.every_definition if d.kind == "assign"]
    made = [d for d in named if d.value is form.node or _averages(d.value, form.node)]
    if not form.is_map or not made or "." in made[0].place:
        return [], []
    unused: List[cst.CSTNode] = []
    masks: List[cst.CSTNode] = []
    compared: List[cst.CSTNode] = []  # or squared, or scaled: a weight moves the threshold
    for part in walk_expressions(function.body):
        is_square = isinstance(part, cst.BinaryOperation) and isinstance(part.operator, cst.Power)
        if is_square or isinstance(part, cst.Comparison):
            compared.append(part.left)  # type: ignore[attr-defined]
        elif isinstance(part, cst.Attribute) and part.attr.value in SIZES:
            unused.append(part.value)
        elif isinstance(part, cst.Call) and call_name(part) in EXTREMES and not part.args:
            compared += attribute_chain(part.func)
        elif isinstance(part, cst.Call) and call_name(part) in TRANSFORMS:
            compared += walk_expressions(part)
        elif isinstance(part, cst.AugAssign):
            unused += attribute_chain(part.target)
        elif isinstance(part, cst.Call) and call_name(part) in LEAVES:
            unused += attribute_chain(part)
        elif isinstance(part, cst.Call) and makes_mask(part):
            masks += [node for each in (part.func, *(arg.value for arg in part.args)) for node in attribute_chain(each)]
    reads = [read for read in function.flow.reads if made[0] in function.flow.reaching(read)]
    reads = [read for read in reads if read not in unused and not no_grad_around(function, read)]
    loss = [read for read in reads if training.includes(read) and read not in masks]
    averaged = made[0].value is not form.node
    is_changed = any(read in compared or (averaged and read in masks) for read in reads)
    others = [] if averaged else [read for read in reads if read not in loss]
    return loss, reads if is_changed else others


def _averages(value: Optional[cst.CSTNode], node: cst.CSTNode) -> bool:
    """Return whether a value is the mean of an error map over an axis."""
    if not isinstance(value, cst.Call) or call_name(value) != "mean":
        return False
    return any(part is node for part in (*attribute_chain(value.func), *(arg.value for arg in value.args)))


def is_measured(function: Function, form: Form) -> bool:
    """Return whether a term is only a number: ``error.mean().item()``, or compared, ``abs(height - wanted) > 0.1``."""
    numbers = [part for call in function.flow.calls if call_name(call) in LEAVES for part in attribute_chain(call)]
    compared = [part.left for part in walk_expressions(function.body) if isinstance(part, cst.Comparison)]
    return any(part is form.node for part in (*numbers, *compared))
