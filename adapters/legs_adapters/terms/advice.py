"""What to write by hand for a term that cannot be edited."""

from __future__ import annotations

import re

import libcst as cst

from legs_adapters.code.syntax import code, one_line
from legs_adapters.lexicon.masks import without_rows
from legs_adapters.tensors.absolute import abs_argument
from legs_adapters.terms.forms import Form

__all__ = ["advice", "difference_of", "is_torch_l1"]


def advice(form: Form, flipped: bool, last: bool, rows: bool) -> str:
    """What to write by hand: the pictures themselves, where the form has lists of their pixels."""
    prediction, target = (form.second, form.first) if flipped else (form.first, form.second)
    whole, other = without_rows(prediction), without_rows(target)
    if whole is not prediction and other is not target:
        image, photo = one_line(whole), one_line(other)
        return f"legs_loss.l1_loss({image}, {photo}.reshape({image}.shape), channels_last=True)"
    if form.reduction == "signed":
        mean = ".mean()" if form.node is not form.call else ""
        weight = f"legs_loss.weight_map({one_line(target)}{', channels_last=True' if last else ''})"
        return f"torch.abs({weight} * {one_line(difference_of(form))}){mean}"
    if form.reduction == "taken":
        weight = f"legs_loss.weight_map({one_line(target)}{', channels_last=True' if last else ''})"
        return one_line(_with_weight(form, weight))
    if rows:
        return "legs_loss.l1_loss(rendering, photograph), with the pictures before they became lists"
    settings = ", channels_last=True" if last else ""
    settings += ', reduction="none"' if form.reduction == "none" else ""
    if form.callee is not None and form.reduction == "own" and not form.extras and not is_torch_l1(form.callee):
        settings += (
            f", own={one_line(form.callee)}" if not flipped else f", own=lambda a, b: {one_line(form.callee)}(b, a)"
        )
    if form.callee is not None and form.extras:
        first, second = ("b", "a") if flipped else ("a", "b")
        extras = ", ".join(one_line(extra.with_changes(comma=cst.MaybeSentinel.DEFAULT)) for extra in form.extras)
        settings += f", own=lambda a, b: {one_line(form.callee)}({first}, {second}, {extras})"
    return f"legs_loss.l1_loss({one_line(prediction)}, {one_line(target)}{settings})"


def _with_weight(form: Form, weight: str) -> cst.Call:
    """``robust(weight * residual, config)``."""
    first = form.call.args[0]
    product = cst.parse_expression(f"{weight} * {one_line(first.value)}")
    return form.call.with_changes(args=(first.with_changes(value=product), *form.call.args[1:]))


def difference_of(form: Form) -> cst.BaseExpression:
    """What the absolute value is taken of."""
    difference = abs_argument(form.call)
    assert difference is not None
    return difference


def is_torch_l1(callee: cst.BaseExpression) -> bool:
    """``F.l1_loss``, whose mean needs no ``own=``."""
    return re.search(r"(^|\.)(F|functional)\.l1_loss$", code(callee)) is not None
