"""Find from the code around an expression what it is, independent of its name: a mask, a crop, a rendering."""

from __future__ import annotations

from typing import List

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, constant, root_of, same, walk_expressions, words
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.words import CAMERAS, GAUSSIANS, LOADERS, RESULT

__all__ = [
    "are_neighbours",
    "draws",
    "is_asked_for",
    "is_box",
    "is_cropped",
    "is_loaded",
    "is_masked",
    "is_taken_from_one",
]


def draws(values: List[cst.BaseExpression]) -> bool:
    """Return whether a function is given Gaussians and a camera, ``imlsplat(gaussians, viewpoint_cam, background)``."""
    names = [root_of(value) for value in values if isinstance(value, (cst.Name, cst.Attribute))]
    spoken = [set(words(name)) for name in names]
    return any(each & GAUSSIANS for each in spoken) and any(each & CAMERAS for each in spoken)


def is_box(function: Function, node: cst.CSTNode) -> bool:
    """Return whether a kernel is all ones, which blurs."""
    found = function.flow.definitions.get(node.value, []) if isinstance(node, cst.Name) else []
    made = [definition.value for definition in found if definition.kind == "assign"]
    return bool(made) and all(isinstance(value, cst.Call) and call_name(value) == "ones" for value in made)


def is_cropped(function: Function, node: cst.Name) -> bool:
    """Return whether the only definition of a name is a part of an image, ``image[:, :half]``."""
    made = function.flow.assigned(node)
    return len(made) == len(function.flow.reaching(node)) and all(
        isinstance(value, cst.Subscript) and all(isinstance(part.slice, cst.Slice) for part in value.slice)
        for value in made
    )


def is_masked(function: Function, node: cst.Name) -> bool:
    """Return whether the only definition of a name that also has a word for images is a product."""
    made = function.flow.assigned(node)
    products = [v for v in made if isinstance(v, cst.BinaryOperation) and isinstance(v.operator, cst.Multiply)]
    says_image = any(kind_of_words(word) == "image" for word in words(node.value))
    return says_image and bool(made) and len(products) == len(made)


def is_taken_from_one(function: Function, node: cst.Name) -> bool:
    """Return whether ``1 - objects`` is computed somewhere: it is a mask then, whatever its name."""
    return any(
        isinstance(part, cst.BinaryOperation)
        and isinstance(part.operator, cst.Subtract)
        and constant(part.left) == 1
        and same(part.right, node)
        for part in function.flow.expressions
    )


def are_neighbours(left: cst.BaseExpression, right: cst.BaseExpression) -> bool:
    """Return whether two expressions are shifted parts of one picture: ``x[1:] - x[:-1]``."""
    return isinstance(left, cst.Subscript) and isinstance(right, cst.Subscript) and same(left.value, right.value)


def is_loaded(function: Function, node: cst.CSTNode, key: str) -> bool:
    """Return whether a dictionary is from a data loader, and the entry too, not from a renderer."""
    made = [d for d in function.flow.reaching(node) if d.kind != "store" or d.key in (None, key)]
    sources = [part for d in made if d.kind == "element" and d.value is not None for part in walk_expressions(d.value)]
    loaders = [part for part in sources if isinstance(part, cst.Name) and set(words(part.value)) & LOADERS]
    return bool(loaders) and all(d.kind == "element" for d in made)


def is_asked_for(key: str) -> bool:
    """Return whether a key only says that it is a result: ``images_output``."""
    return all(role_of_words(word) != "render" or word in RESULT for word in words(key))
