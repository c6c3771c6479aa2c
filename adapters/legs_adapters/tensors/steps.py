"""Calls that run a backward pass or step an optimiser, and what reads the gradients between them."""

from __future__ import annotations

import ast
import functools
from typing import Iterable, List

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, walk_expressions, words, words_in
from legs_adapters.tensors.operations import BACKWARD, OPTIMISERS, SCHEDULES, STEPS


def is_backward(call: ast.Call) -> bool:
    """Return whether a call runs a backward pass."""
    return call_name(call) in BACKWARD


def is_step(call: ast.Call) -> bool:
    """Return whether a call steps an optimiser: ``optimizer.step()``, ``optimizers.optimizer_step_all()``."""
    tokens = set(words(call_name(call)))
    is_named = "step" in tokens and (len(tokens) == 1 or bool(tokens & OPTIMISERS))
    return isinstance(call.func, ast.Attribute) and is_named and not _is_of_schedule(call)


def may_step(calls: Iterable[ast.Call]) -> bool:
    """Return whether a call may be a step, by its name: ``gaussians.update(opt)``; not ``pbar.update(1)``."""
    return any(set(words(call_name(call))) & STEPS and not _is_of_schedule(call) for call in calls)


def _is_of_schedule(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Attribute) and bool(words_in(call.func.value) & SCHEDULES)


def has_step(function: Function) -> bool:
    """Return whether an optimiser steps in a function; its text, which may be the whole file's, is only a filter."""
    return "step" in function.text and any(map(is_step, function.flow.calls))


@functools.lru_cache(maxsize=64)  # a term asks about what is called after it, and the next term again
def reads_gradients(function: Function) -> bool:
    """Return whether a function reads gradients, ``xyz.grad``; not where they are only compared, assigned or reset."""
    parts = list(function.walk()) if ".grad" in function.text else []
    others: List[ast.AST] = [part for part in parts if isinstance(part, ast.Compare)]
    others += [target for part in parts if isinstance(part, ast.Assign) for target in part.targets]
    unread = {id(each) for each in walk_expressions(*others)}
    return any(isinstance(p, ast.Attribute) and p.attr == "grad" and id(p) not in unread for p in parts)
