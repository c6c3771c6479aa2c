"""Calls that run a backward pass or step an optimiser, and what reads the gradients between them."""

from __future__ import annotations

from typing import Iterable, List

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, children, constant, walk_all, words, words_under
from legs_adapters.tensors.operations import BACKWARD, OPTIMISERS, SCHEDULES, STEPS

__all__ = [
    "gradients_read",
    "has_step",
    "is_backward",
    "is_step",
    "may_step",
]

_NOTHING = object()


def is_backward(call: cst.Call) -> bool:
    """Return whether a call runs a backward pass."""
    return call_name(call) in BACKWARD


def is_step(call: cst.Call) -> bool:
    """Return whether a call steps an optimiser: ``optimizer.step()``, ``optimizers.optimizer_step_all()``."""
    said = set(words(call_name(call)))
    if not isinstance(call.func, cst.Attribute) or not (said == {"step"} or ("step" in said and said & OPTIMISERS)):
        return False
    return not _is_of_schedule(call)


def may_step(calls: Iterable[cst.Call]) -> bool:
    """Return whether a call may be a step, by its name: ``gaussians.update(opt)``; not ``pbar.update(1)``."""
    return any(set(words(call_name(call))) & STEPS and not _is_of_schedule(call) for call in calls)


def _is_of_schedule(call: cst.Call) -> bool:
    return isinstance(call.func, cst.Attribute) and bool(words_under(call.func.value) & SCHEDULES)


def has_step(function: Function) -> bool:
    """Return whether an optimiser steps in a function; its text, which may be the whole file's, is only a filter."""
    return "step" in function.text and any(map(is_step, function.flow.calls))


def gradients_read(parts: List[cst.CSTNode]) -> List[cst.Attribute]:
    """Return the gradients that are read, ``xyz.grad``; none where a manual step uses one of them."""
    asked = {id(p) for part in parts if _asks(part) for p in walk_all(part)}
    taken = {id(p) for part in parts for given in _taken(part) for p in walk_all(given)}
    read = [p for p in parts if isinstance(p, cst.Attribute) and p.attr.value == "grad" and id(p) not in asked]
    return [] if any(id(p) in taken for p in read) else read


def _empties(node: cst.CSTNode) -> bool:
    """Return whether a node is ``xyz.grad = None``, which resets the gradients."""
    if not isinstance(node, cst.Assign) or constant(node.value, _NOTHING) is not None:
        return False
    return any(isinstance(t.target, cst.Attribute) and t.target.attr.value == "grad" for t in node.targets)


def _asks(node: cst.CSTNode) -> bool:
    """Return whether a gradient is only compared or reset: ``xyz.grad is not None``."""
    return isinstance(node, cst.Comparison) or _empties(node)


def _taken(node: cst.CSTNode) -> List[cst.CSTNode]:
    """Return the operands of a manual step: ``xyz -= lr * xyz.grad``, ``xyz.data.add_(-lr * xyz.grad)``."""
    if isinstance(node, cst.AugAssign):
        return [node.value] if isinstance(node.operator, cst.SubtractAssign) else []
    if isinstance(node, cst.BinaryOperation):  # xyz.grad - other.grad compares the two
        of_grads = any(isinstance(p, cst.Attribute) and p.attr.value == "grad" for p in walk_all(node.left))
        return [node.right] if isinstance(node.operator, cst.Subtract) and not of_grads else []
    in_place = isinstance(node, cst.Call) and call_name(node).endswith("_")
    return [child.value for child in children(node) if in_place and isinstance(child, cst.Arg)]
