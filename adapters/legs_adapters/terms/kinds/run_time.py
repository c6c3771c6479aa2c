"""A loss whose function is chosen at run time, ``loss_fn = eval(f"{kind}_loss")``, beside D-SSIM of the same pair."""

from __future__ import annotations

from typing import List, Optional, Sequence

import libcst as cst

from legs_adapters.code.calls import BY_NAME
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, same
from legs_adapters.lexicon.names import is_l1_name
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.called import Called
from legs_adapters.terms.ssim import is_given

__all__ = ["chosen_at_run_time"]


def chosen_at_run_time(program: Program, training: Training, function: Function, known: Sequence[Form]) -> List[Form]:
    """Return the calls that may be the L1 of a function's loss, from the SSIM beside them.

    The call has the two images of an SSIM, and its function is looked up by a name from the settings.
    ``known`` are the function's own forms: their pairs have an L1 already.
    """
    structural = [
        call for call in function.flow.calls if STRUCTURAL.search(call_name(call)) and training.includes(call)
    ]
    found: List[Form] = []
    for call in function.flow.calls if structural else ():
        positional, keywords, starred = arguments(call)
        if len(positional) != 2 or keywords or starred or not training.includes(call):
            continue
        first, second = positional
        beside = any(is_given(function, other, first) and is_given(function, other, second) for other in structural)
        settled = any(same(form.first, first) and same(form.second, second) for form in known)
        if beside and not settled and _is_looked_up(program, function, call):
            found.append(Called(call, call, first, second, call.func))
    return found


def _is_looked_up(program: Program, function: Function, call: cst.Call) -> bool:
    """Return whether the called function depends on settings."""
    if program.resolve(function, call.func) or is_l1_name(call_name(call)):
        return False
    definitions = program.lookup(function, call.func) or []
    owner = program.owner_of(function)
    if not definitions and owner is not None and isinstance(call.func, cst.Attribute):
        definitions = owner.stores(call.func.attr.value)
    made = [definition.value for _, definition in definitions if definition.kind == "assign"] or [call.func]
    return all(map(_looks_up, made))


def _looks_up(value: Optional[cst.CSTNode]) -> bool:
    """Return whether a value is looked up by a name: ``eval(name)``, ``getattr(losses, name)``, ``losses[name]``."""
    if isinstance(value, cst.Subscript):
        return key_of(value) is None
    if not isinstance(value, cst.Call) or call_name(value) not in BY_NAME:
        return False
    return not any(isinstance(constant(arg.value), str) for arg in value.args)
