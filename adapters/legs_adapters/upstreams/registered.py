"""A loss registered as a callable: NeRFICG, and FasterGS in it.

``self.add_loss_metric('L1_Color', torch.nn.functional.l1_loss, weight)`` registers the function; the framework
calls it later, with ``input=`` and ``target=``. The callable is replaced.
"""

from __future__ import annotations

import re
from typing import List

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, call_name, constant, dotted
from legs_adapters.lexicon.names import is_l1_name, kind_of_words
from legs_adapters.terms.form import Form
from legs_adapters.terms.kinds.callback import PassedByName

__all__ = ["MENTIONED", "forms_of"]


MENTIONED = re.compile(r"\badd_loss_metric\s*\(")


def forms_of(program: Program, function: Function, call: cst.Call) -> List[Form]:
    """Return the form of a registered photometric L1, whose node is the callable; nothing for any other call."""
    if call_name(call) != "add_loss_metric":
        return []
    positional, keywords, _ = arguments(call)
    name = constant(keywords.get("name", positional[0] if positional else None))
    metric = keywords.get("metric", positional[1] if len(positional) > 1 else None)
    if not isinstance(name, str) or metric is None or kind_of_words(name) not in ("image", None):
        return []
    form = PassedByName(metric, call, cst.Name("input"), cst.Name("target"), metric)
    return [form] if _is_l1(program, function, metric) else []


def _is_l1(program: Program, function: Function, node: cst.BaseExpression) -> bool:
    references = program.resolve(function, node)
    if references:
        return all(is_l1_name(str(getattr(r.target, "name", r.target)).split(".")[-1]) for r in references)
    return is_l1_name((dotted(node) or "").split(".")[-1])
