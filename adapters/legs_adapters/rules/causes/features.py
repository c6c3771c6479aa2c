"""Skip a term that compares features: network outputs, laser scans, or maps with names of their own."""

from __future__ import annotations

from typing import Iterator, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, code, constant, dotted, key_of, walk_expressions, words
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.words import OF_PHOTOGRAPHS, PERCEPTUAL
from legs_adapters.rules.rule import Rule, Term, header
from legs_adapters.rules.splats import made_of
from legs_adapters.tensors.operations import KEEPS_VALUES
from legs_adapters.terms.findings import Decider
from legs_adapters.terms.forms import Forms

__all__ = ["NamedMap", "Network", "Scan", "compared"]


class _Feature(Rule):
    reason = "features"
    is_picture = True


class Scan(_Feature):
    """One side is a channel of a laser scan.

    left:
        def training(gaussians, camera):
            scan = camera.scan_image
            gt_depth = scan[2:3]
            gt_image = scan[1:2]
            image = render(camera, gaussians, None, None)["render"]
            loss = l1_loss(image, gt_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "scan"

    def evidence(self, term: Term) -> List[Decider]:
        function = term.function
        scans = {name for part in made_of(function, term.form) for name in [_one_channel_of(part)] if name is not None}
        depths = [place for place in function.flow.definitions if scans and kind_of_words(place) == "depth"]
        values = [definition.value for place in depths for definition in function.flow.definitions[place]]
        parts = [part for value in values if value for part in walk_expressions(value)]
        return [(function, part) for part in parts if _one_channel_of(part) in scans][:1]


class Network(_Feature):
    """The term is part of a perceptual loss, and its sides are outputs of a network.

    left:
        def perceptual_loss(network, image, gt):
            image_layer, gt_layer = network(image), network(gt)
            return l1_loss(image_layer, gt_layer)

        def training(gaussians, camera, network):
            image = render(camera, gaussians, None, None)["render"]
            loss = perceptual_loss(network, image, camera.original_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(image, gt)
    """

    id = "network"

    def evidence(self, term: Term) -> List[Decider]:
        if all(_is_given_whole(term.function, side) for side in term.sides):
            return []
        names = [*term.names_around, (term.function.module.path.rpartition("/")[2], header(term.function))]
        return [decider for name, decider in names if PERCEPTUAL & set(words(name))][:1]


class NamedMap(_Feature):
    """Both names share a word that is not for images, and another L1 compares the images of the same two objects.

    left:
        def training(gaussians, camera):
            package = render(camera, gaussians, None, None)
            loss = l1_loss(package["surf_image"], camera.surf_image)
            loss = loss + l1_loss(package["image"], camera.original_image)
            loss.backward()
            gaussians.optimizer.step()

    weighted: loss = l1_loss(package["image"], camera.original_image)
    """

    id = "named-map"

    def evidence(self, term: Term) -> List[Decider]:
        function, forms = term.function, term.analysis.forms
        own = _entries(function, *term.sides)
        if not own or own[0][0] == own[1][0] or not _special(own[0][1]) & _special(own[1][1]):
            return []
        beside = function.owner.methods.values() if function.owner is not None else (function,)
        for scope in beside:
            for call, one, other in compared(forms, scope):
                found = _entries(scope, one, other)
                holders = {holder for holder, _ in found} == {own[0][0], own[1][0]}
                if holders and not any(_special(name) for _, name in found):
                    return [(scope, call)]
        return []


def compared(forms: Forms, function: Function) -> Iterator[Tuple[cst.Call, cst.CSTNode, cst.CSTNode]]:
    """Yield each L1 in a function with its two sides, already weighted ones included."""
    for form in forms.of(function):
        yield form.call, form.first, form.second
    for call in function.flow.calls:
        if dotted(call.func) == "legs_loss.l1_loss" and len(call.args) > 1:
            yield call, call.args[0].value, call.args[1].value


def _is_given_whole(function: Function, node: cst.CSTNode) -> bool:
    """Return whether an expression is an unchanged parameter."""
    found = function.flow.reaching(node)
    return bool(found) and all(definition.kind == "parameter" for definition in found)


def _one_channel_of(node: cst.CSTNode) -> Optional[str]:
    """Return ``scan`` of ``scan[1:2, ...]``."""
    if not isinstance(node, cst.Subscript) or not isinstance(node.value, cst.Name):
        return None
    first = node.slice[0].slice
    if not isinstance(first, cst.Slice):
        return None
    lower, upper = constant(first.lower), constant(first.upper)
    return node.value.value if isinstance(lower, int) and upper == lower + 1 else None


def _entries(function: Function, *sides: cst.CSTNode) -> List[Tuple[str, str]]:
    """Return the object and the name that each side is an entry of; nothing where a side is not an entry."""
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
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and call_name(node) in KEEPS_VALUES:
        return _entry(function, node.func.value, seen)
    if isinstance(node, cst.Attribute):
        return code(node.value), node.attr.value
    if isinstance(node, cst.Subscript):
        key = key_of(node)
        return (code(node.value), key) if isinstance(key, str) else _entry(function, node.value, seen)
    return None


def _special(name: str) -> Set[str]:
    """Return the words of a name that are not for images, nor for one of several images."""
    found = {word for word in words(name) if not word.isdigit() and role_of_words(word) is None}
    return {word for word in found if kind_of_words(word) != "image"} - OF_PHOTOGRAPHS
