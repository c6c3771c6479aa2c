"""The two sides of an L1: what both of them share, which is the ground truth, and whether they are pictures still."""

from __future__ import annotations

import re
from typing import Iterable, List, NamedTuple, Optional, Tuple

import libcst as cst

from legs_adapters.reading.entries import called_makers, written
from legs_adapters.reading.l1 import Form
from legs_adapters.reading.meaning import Meaning, Meanings
from legs_adapters.reading.module import Function
from legs_adapters.reading.syntax import (
    arguments,
    attribute_chain,
    call_name,
    code,
    constant,
    key_of,
    same,
    walk_expressions,
    word_set,
    words,
)
from legs_adapters.reading.vocabulary import kind_of_words, role_of_words

__all__ = [
    "Pair", "are_counterparts", "is_detached", "is_role", "is_rows", "makes_mask", "of_rays", "pair_of", "picked_from",
    "same_root", "swapped", "without_rows",
]  # fmt: skip

_MASK_WORDS = word_set("mask masks valid bool fg region visible hit keep inside foreground sel robust inliers")
_RAYS = re.compile(r"(\b|_)(rays?|nerf|neus)(_|\b)", re.I)
_DEPTH = 4


class Pair(NamedTuple):
    """What is compared.

    Attributes:
        first, second: the two sides, without an index by a mask that both carry.
        selection: that index as written, with its brackets; empty without.
        a, b: what the two stand for; a factor that both have says nothing of it.
    """

    first: cst.BaseExpression
    second: cst.BaseExpression
    selection: str
    a: Meaning
    b: Meaning

    @property
    def speaks_of_images(self) -> bool:
        """Whether both sides have a name that speaks of an image."""
        return _speaks_of_images(self.first) and _speaks_of_images(self.second)


def pair_of(meanings: Meanings, function: Function, form: Form) -> Pair:
    """Look at the two sides of a form."""
    first, second, selection = form.first, form.second, ""
    if isinstance(first, cst.Subscript) and isinstance(second, cst.Subscript):
        inner = [code(node)[len(code(node.value)) :] for node in (first, second)]
        squeezed = [re.sub(r"\s+", "", text) for text in inner]
        if squeezed[0] == squeezed[1] and any(_is_mask(meanings, function, element) for element in first.slice):
            # the weight map needs the whole image
            first, second, selection = first.value, second.value, inner[0].strip()
    left, right = _without_shared_factors(first, second)
    return Pair(first, second, selection, meanings.of(function, left), meanings.of(function, right))


def _without_shared_factors(first: cst.BaseExpression, second: cst.BaseExpression) -> List[cst.BaseExpression]:
    """``image * (1 - mask)`` and ``gt * (1 - mask)`` are ``image`` and ``gt``."""
    if not (isinstance(first, cst.BinaryOperation) and isinstance(second, cst.BinaryOperation)):
        return [first, second]
    if not (isinstance(first.operator, cst.Multiply) and isinstance(second.operator, cst.Multiply)):
        return [first, second]
    for one, factor in ((first.left, first.right), (first.right, first.left)):
        for other, again in ((second.left, second.right), (second.right, second.left)):
            if same(factor, again):
                return _without_shared_factors(one, other)
    return [first, second]


def _is_mask(meanings: Meanings, function: Function, element: cst.SubscriptElement) -> bool:
    if not isinstance(element.slice, cst.Index):
        return False
    node: cst.CSTNode = element.slice.value
    if isinstance(node, (cst.Comparison, cst.UnaryOperation)):
        return constant(node) is None
    if isinstance(node, cst.BinaryOperation):
        return isinstance(node.operator, (cst.BitAnd, cst.BitOr, cst.BitXor))
    if isinstance(node, cst.Call):
        return call_name(node) in ("bool", "squeeze", "expand", "expand_as", "repeat", "logical_not", "logical_and")
    name = node.value if isinstance(node, cst.Name) else node.attr.value if isinstance(node, cst.Attribute) else ""
    return bool(set(words(name)) & _MASK_WORDS) or meanings.of(function, node).kind == "mask"


def swapped(a: Meaning, b: Meaning) -> Optional[bool]:
    """Which of the two is the ground truth: False for the second; None where that is not clear."""
    if b.role == "target" and a.role != "target":
        return False
    if a.role == "target" and b.role != "target":
        return True
    if a.role == "render" and b.role is None:
        return False
    if b.role == "render" and a.role is None:
        return True
    # of a composite of both and one of them, the composite is the other
    if (a.role == "render" and b.role == "both") or (a.role == "both" and b.role == "target"):
        return False
    if (a.role == "both" and b.role == "render") or (a.role == "target" and b.role == "both"):
        return True
    return None


def same_root(form: Form) -> bool:
    """``x[1:] - x[:-1]``: a picture against itself."""
    a, b = form.first, form.second
    if not (isinstance(a, cst.Subscript) and isinstance(b, cst.Subscript)) or isinstance(key_of(a), str):
        return False
    return same(a.value, b.value) and not same(a, b)


def are_counterparts(form: Form) -> bool:
    """``rendered_lips`` and ``gt_lips``: the same thing, once rendered and once photographed."""
    names = []
    for node in (form.first, form.second):
        key = key_of(node)
        text = node.value if isinstance(node, cst.Name) else key if isinstance(key, str) else ""
        names.append((role_of_words(text), [w for w in words(text) if role_of_words(w) is None], words(text)))
    (a, rest_a, _), (b, rest_b, _) = names
    spoken = {word for _, _, each in names for word in each}
    rendered = any(word.startswith("render") for word in spoken)
    return {a, b} == {"render", "target"} and bool(rest_a) and rest_a == rest_b and rendered


def is_detached(node: cst.CSTNode) -> bool:
    """Whether no gradient goes that way."""
    return any(isinstance(part, cst.Call) and call_name(part) in ("detach", "item") for part in attribute_chain(node))


def makes_mask(call: cst.Call) -> bool:
    """Whether a function makes a mask of an error map, going by its name."""
    return bool(set(words(call_name(call))) & _MASK_WORDS) or call_name(call) == "quantile"


def of_rays(form: Form) -> bool:
    """Whether the names speak of rays, or of a field that they go through: a list of colours, whatever it is called."""
    return any(_RAYS.search(code(node)) for node in (form.first, form.second))


def is_role(node: cst.CSTNode) -> bool:
    """Whether a name says nothing but what it is to the loss: ``pred``, ``target``."""
    return isinstance(node, cst.Name) and all(role_of_words(word) is not None for word in words(node.value))


def is_rows(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Whether an expression is a list of pixels, ``image.reshape(-1, 3)``: their neighbours are not known any more."""

    def are(parts: Iterable[Tuple[Function, cst.CSTNode]]) -> bool:
        return any(is_rows(meanings, where, part, depth + 1) for where, part in parts)

    if depth > _DEPTH:
        return False
    if isinstance(node, cst.BinaryOperation):
        return are([(function, node.left), (function, node.right)])
    if isinstance(node, cst.Subscript):
        key = key_of(node)
        makers = called_makers(meanings.program, function, node.value) if isinstance(key, str) else []
        return are(written(makers, str(key)) or [(function, node.value)])
    if isinstance(node, cst.Name):
        found = [d for d in function.flow.reaching(node) if constant(d.value, d) is not None]
        if any(d.kind == "assign" and _is_picked(meanings, function, d.value) for d in found):
            return True
        added = [d.value for d in found if d.kind == "mutate" and isinstance(d.value, cst.Call)]
        if added:  # crops = [], then crops.append(crop.flatten())
            return are((function, value) for call in added for value in arguments(call)[0])
        return len(found) == 1 and found[0].kind == "assign" and are((function, d.value) for d in found if d.value)
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
        if _to_rows(node) or _flattens(node):
            return True
        if call_name(node) in ("cat", "concat"):
            return are((function, arg.value) for arg in node.args[:1])
        return call_name(node) in ("float", "cuda", "to", "clamp", "detach") and are([(function, node.func.value)])
    return False


def _is_picked(meanings: Meanings, function: Function, node: Optional[cst.CSTNode]) -> bool:
    """``image[:, mask]``: the pixels of a mask."""
    return isinstance(node, cst.Subscript) and any(_is_mask(meanings, function, part) for part in node.slice)


def picked_from(meanings: Meanings, function: Function, node: cst.CSTNode) -> Optional[cst.Subscript]:
    """``image[:, mask]``, for a name that stands for that and nothing else."""
    found = function.flow.reaching(node) if isinstance(node, cst.Name) else ()
    values = [definition.value for definition in found if definition.kind == "assign"]
    value = values[0] if len(found) == len(values) == 1 else None
    return value if isinstance(value, cst.Subscript) and _is_picked(meanings, function, value) else None


def _flattens(node: cst.Call) -> bool:
    """``image.flatten()``, ``image.reshape(3, -1)``, ``torch.masked_select(image, mask)``."""
    if call_name(node) in ("reshape", "view"):
        sizes = [constant(value) for value in arguments(node)[0]]
        return -1 in sizes and len(sizes) < 3
    return call_name(node) == "masked_select" or (call_name(node) in ("flatten", "ravel") and not node.args)


def without_rows(node: cst.BaseExpression) -> cst.BaseExpression:
    """Return ``image`` of ``image.reshape(-1, 3)``; anything else as it is."""
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and _to_rows(node):
        return node.func.value
    return node


def _to_rows(node: cst.Call) -> bool:
    sizes = [constant(value) for value in arguments(node)[0]]
    if len(sizes) == 1 and isinstance(sizes[0], tuple):
        sizes = list(sizes[0])
    return call_name(node) in ("reshape", "view") and len(sizes) == 2 and sizes[0] == -1 and sizes[1] in (1, 3, 4)


def _speaks_of_images(node: cst.CSTNode) -> bool:
    return any(
        kind_of_words(str(part.value if isinstance(part, cst.Name) else constant(part))) == "image"
        for part in walk_expressions(node)
        if isinstance(part, (cst.Name, cst.SimpleString))
    )
