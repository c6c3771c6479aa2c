"""What a step compares beside its photographs: maps with a name of their own, a picture that never changes; SSIM."""

from __future__ import annotations

from typing import Iterator, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import (
    attribute_chain,
    call_name,
    code,
    dotted,
    key_of,
    loops_around,
    walk_expressions,
    word_set,
    words,
)
from legs_adapters.lexicon.meaning import Meaning
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.renderings import is_rendering
from legs_adapters.terms.form import Form
from legs_adapters.terms.forms import Forms

__all__ = ["is_always_the_same", "is_another_map", "is_under_mask"]

_KEEPS = word_set("clamp clip clone contiguous cuda detach float permute squeeze to unsqueeze")
_OF_VIEWS = word_set("batch cam camera cameras cams data frame frames item scene view views viewpoint viewpoints")
# Which photograph it is, or which part of one; and what is said of anything.
_OF_PHOTOGRAPHS = word_set(
    """
    left right front back blur blurred blurry sharp hdr ldr nir infrared raw patch crop face head hand hands lips
    map tensor
    """
)


def is_under_mask(form: Form, side: cst.CSTNode, meaning: Meaning) -> bool:
    """``l1_loss_masked(image, data["seg_im"], mask)``: the photograph under the mask that the L1 is given beside it."""
    masked = form.callee is not None and {"mask", "masked"} & set(words(call_name(form.call))) and form.extras
    name = side.value if isinstance(side, cst.Name) else str(key_of(side) or "")
    return bool(masked) and meaning.kind == "mask" and any(kind_of_words(word) == "image" for word in words(name))


def is_another_map(forms: Forms, function: Function, form: Form) -> bool:
    """``package["surf"]`` and ``cam.surf_image``, where ``package["render"]`` meets ``cam.original_image``.

    So two that share a word of no picture, where the pictures of the same two holders are compared in the function
    or in a method beside it.
    """
    own = _entries(function, form.first, form.second)
    if not own or own[0][0] == own[1][0] or not _special(own[0][1]) & _special(own[1][1]):
        return False
    beside = function.owner.methods.values() if function.owner is not None else (function,)
    others = [_entries(scope, one, other) for scope in beside for _, one, other in _compared(forms, scope)]
    return any(
        {holder for holder, _ in entries} == {own[0][0], own[1][0]} and not any(_special(name) for _, name in entries)
        for entries in others
    )


def is_always_the_same(
    forms: Forms, function: Function, form: Form, prediction: cst.CSTNode, target: cst.CSTNode
) -> bool:
    """``detector(image)`` and ``message``, made before the loop that renders the views, of nothing that has views."""
    loops = loops_around(function.body, form.call)
    made = function.flow.reaching(list(attribute_chain(target))[-1])
    values = [d.value for d in made if d.kind == "assign" and isinstance(d.value, cst.Call)]
    if not loops or not values or len(values) != len(made) or is_rendering(function, prediction):
        return False
    named = [part for value in values for part in walk_expressions(value) if isinstance(part, cst.Name)]
    inside = {id(part) for part in walk_expressions(loops[-1])}
    if any(id(name) in inside or set(words(name.value)) & _OF_VIEWS for name in named):
        return False
    return any(
        id(call) in inside and (is_rendering(function, one) or is_rendering(function, other))
        for call, one, other in _compared(forms, function)
    )


def _compared(forms: Forms, function: Function) -> Iterator[Tuple[cst.Call, cst.CSTNode, cst.CSTNode]]:
    """Each L1 in a function with its two sides, whether or not it has been weighted already."""
    for form in forms.of(function):
        yield form.call, form.first, form.second
    for call in function.flow.calls:
        if dotted(call.func) == "legs_loss.l1_loss" and len(call.args) > 1:
            yield call, call.args[0].value, call.args[1].value


def _entries(function: Function, *sides: cst.CSTNode) -> List[Tuple[str, str]]:
    """What the sides are entries of, and under which names; nothing where one is none."""
    found = [_entry(function, side, set()) for side in sides]
    return [entry for entry in found if entry is not None] if None not in found else []


def _entry(function: Function, node: Optional[cst.CSTNode], seen: Set[int]) -> Optional[Tuple[str, str]]:
    if node is None or id(node) in seen:
        return None
    seen.add(id(node))
    if isinstance(node, cst.Name):
        made = list(function.flow.reaching(node))
        if len(made) == 1 and made[0].kind == "element":
            return "", node.value  # of what a renderer returns together
        return _entry(function, made[0].value, seen) if len(made) == 1 and made[0].kind == "assign" else None
    if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Multiply):  # image * mask
        return _entry(function, node.left, seen)
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and call_name(node) in _KEEPS:
        return _entry(function, node.func.value, seen)
    if isinstance(node, cst.Attribute):
        return code(node.value), node.attr.value
    if isinstance(node, cst.Subscript):
        key = key_of(node)
        return (code(node.value), key) if isinstance(key, str) else _entry(function, node.value, seen)
    return None


def _special(name: str) -> Set[str]:
    """The words of a name that say neither that it is a picture nor which one."""
    found = {word for word in words(name) if not word.isdigit() and role_of_words(word) is None}
    return {word for word in found if kind_of_words(word) != "image"} - _OF_PHOTOGRAPHS
