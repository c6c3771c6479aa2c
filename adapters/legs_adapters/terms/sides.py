"""The two sides of an L1: what they share, and which one is the target."""

from __future__ import annotations

import ast
from typing import List, NamedTuple, Sequence

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import (
    call_name,
    code,
    indices,
    key_of,
    said_by,
    same,
    walk_expressions,
    words,
)
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.masks import is_mask
from legs_adapters.lexicon.meaning import Meaning
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.ways import PHOTOGRAPH, RENDERING, Ways
from legs_adapters.lexicon.words import OF_RAYS
from legs_adapters.tensors.absolute import is_no_picture
from legs_adapters.tensors.operations import MODULES
from legs_adapters.terms.form import Form
from legs_adapters.terms.text import on_one_line


class Pair(NamedTuple):
    """The two sides that are compared.

    Attributes:
        first, second: the two sides, without an index by a mask that both carry.
        selection: that index as written, with its brackets; empty without.
        a, b: the meanings of the two, without a factor that both have.
        is_proven: the way of each shows a rendering and a photograph, whatever the names are.
    """

    first: ast.expr
    second: ast.expr
    selection: str
    a: Meaning
    b: Meaning
    is_proven: bool = False


def surest(meanings: Meanings, ways: Ways, function: Function, sides: Sequence[ast.AST]) -> Meanings:
    """Return what answers for the sides of a term: their ways, where these prove both; else their names, too."""
    return ways if {ways.meaning(function, side) for side in sides} == {RENDERING, PHOTOGRAPH} else meanings


def pair_of(meanings: Meanings, ways: Ways, function: Function, form: Form) -> Pair:
    """Return the two sides of a form, with their meanings."""
    first, second, selection = form.first, form.second, ""
    if isinstance(first, ast.Subscript) and isinstance(second, ast.Subscript) and same(first.slice, second.slice):
        is_by_mask = any(is_mask(meanings, function, index) for index in indices(first))
        selection = on_one_line(code(first)[len(code(first.value, True)) :]) if is_by_mask else ""
        first, second = (first.value, second.value) if is_by_mask else (first, second)  # the weight map needs all of it
    sides = without_shared_factors(first, second)
    answers = surest(meanings, ways, function, sides)
    a, b = (answers.meaning(function, side) for side in sides)
    return Pair(first, second, selection, a, b, answers is ways)


def without_shared_factors(first: ast.expr, second: ast.expr) -> List[ast.expr]:
    """Return ``image`` and ``gt`` of ``image * (1 - mask)`` and ``gt * (1 - mask)``."""
    if not (isinstance(first, ast.BinOp) and isinstance(second, ast.BinOp)):
        return [first, second]
    if not (isinstance(first.op, ast.Mult) and isinstance(second.op, ast.Mult)):
        return [first, second]
    for one, factor in ((first.left, first.right), (first.right, first.left)):
        for other, again in ((second.left, second.right), (second.right, second.left)):
            if same(factor, again):
                return without_shared_factors(one, other)
    return [first, second]


def same_root(form: Form) -> bool:
    """Return whether an image is compared with itself: ``x[1:] - x[:-1]``."""
    a, b = form.first, form.second
    if not (isinstance(a, ast.Subscript) and isinstance(b, ast.Subscript)) or isinstance(key_of(a), str):
        return False
    return same(a.value, b.value) and not same(a, b)


def is_of_numbers(function: Function, side: ast.AST) -> bool:
    """Return whether a side is a tensor of numbers alone: ``torch.eye(3)``, ``torch.tensor([0.0, 1.0])[:, None]``."""
    value = function.flow.value_of(side) or side
    read = {part.id for part in function.flow.reads_in(value)}
    makes = any(isinstance(part, ast.Call) and call_name(part) in ("eye", "tensor") for part in walk_expressions(value))
    return is_no_picture(value) or (makes and read <= MODULES | {"None", "device"})


def of_rays(form: Form) -> bool:
    """Return whether the names are about rays or a radiance field: lists of colours."""
    return any(OF_RAYS.search(code(node)) for node in (form.first, form.second))


def is_role(node: ast.AST) -> bool:
    """Return whether a name is only a role in the loss: ``pred``, ``target``."""
    return isinstance(node, ast.Name) and all(role_of_words(word) is not None for word in words(node.id))


def speaks_of_images(node: ast.AST) -> bool:
    """Return whether a name in it is about images."""
    return "image" in (kind_of_words(said_by(part)) for part in walk_expressions(node))
