"""Find the layout of an image from the code around it: [C, H, W] as in 3DGS, [H, W, C] as in gsplat."""

from __future__ import annotations

from typing import Iterator, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    call_name,
    constant,
    dotted,
    path_of,
    same,
    squeezed,
    walk_expressions,
    words,
)
from legs_adapters.tensors.axes import (
    FIRST,
    LAST,
    TO_FIRST,
    TO_LAST,
    einops_pattern,
    permutation,
    subject,
    swapped_axes,
)
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.operations import CHANNELS_LAST
from legs_adapters.tensors.votes import Vote, added_axis, permuted, shape_vote, slice_vote

__all__ = ["is_channels_last", "lies_last"]


def is_channels_last(
    training: Training, function: Function, *images: cst.CSTNode, error: Optional[cst.CSTNode] = None
) -> bool:
    """Return whether the images are [H, W, C] or [B, H, W, C]; False without evidence.

    ``error`` is their error, to which a mask may be applied.
    """
    votes = [vote for image in _without_factor(*images) for vote in _votes(training, function, image, set(), 0)]
    votes += _votes_of_callees(training, function, images)
    axes = [added_axis(function, factor) for factor in _factors_of(function, error)]
    votes += [Vote(axis, 2) for axis in axes if axis is not None]
    last, first = (sum(vote.strength for vote in votes if vote.axis == axis) for axis in (LAST, FIRST))
    return last > first


def lies_last(function: Function, index: cst.CSTNode) -> bool:
    """Return whether a mask was spread over channels that are last, ``m.repeat(1, 1, 1, 3)``, before it indexes."""
    for part in walk_expressions(index):
        if isinstance(part, cst.Name):
            made = [definition.value for definition in function.flow.reaching(part)]
            if any(value is not None and lies_last(function, value) for value in made if value is not index):
                return True
        if isinstance(part, cst.Call) and call_name(part) in ("repeat", "expand"):
            sizes = [constant(value) for value in arguments(part)[0]]
            if sizes[-1:] == [3] and len(sizes) in (3, 4) and set(sizes[:-1]) <= {1, -1}:
                return True
    return False


def _without_factor(*images: cst.CSTNode) -> Tuple[cst.CSTNode, ...]:
    """Return ``image`` and ``gt`` of ``weight * image`` and ``weight * gt``: the weight shows no layout."""
    products = [i for i in images if isinstance(i, cst.BinaryOperation) and isinstance(i.operator, cst.Multiply)]
    if len(products) == 2:
        one, other = products
        for factor, rest in ((one.left, one.right), (one.right, one.left)):
            for its, others in ((other.left, other.right), (other.right, other.left)):
                if isinstance(factor, cst.Name) and same(factor, its):
                    return rest, others
    return images


def _factors_of(function: Function, error: Optional[cst.CSTNode]) -> Iterator[cst.CSTNode]:
    """Yield what an error map is multiplied by where it is made: ``error * mask``, ``error.mul(mask)``."""
    for node in function.flow.expressions if error is not None else ():
        if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Multiply):
            if error in (node.left, node.right):
                yield node.right if node.left is error else node.left
        elif isinstance(node, cst.Call) and call_name(node) == "mul" and subject(node) is error and node.args:
            yield node.args[-1].value


def _votes(training: Training, function: Function, node: cst.CSTNode, seen: Set[int], depth: int) -> List[Vote]:
    if depth > 10 or id(node) in seen:
        return []
    seen.add(id(node))
    votes: List[Vote] = []
    if isinstance(node, cst.Call):
        order = permutation(node)
        if order in TO_LAST:
            return [Vote(LAST, 3)]
        if order in TO_FIRST:
            return [Vote(FIRST, 3)]
        pattern = einops_pattern(node)
        if pattern is not None:
            after = pattern.split("->")[-1].split()
            return [Vote(LAST if after[-1:] == ["c"] else FIRST, 3)]
        if call_name(node) in CHANNELS_LAST:
            return [Vote(LAST, 2)]
        if call_name(node) in ("array", "asarray") and node.args and _is_picture(function, node.args[0].value):
            return [Vote(LAST, 3)]
        made = node.func if isinstance(node.func, cst.Call) else node
        if words(call_name(made)) == ("to", "tensor"):  # torchvision's: of an image or an array
            return [Vote(FIRST, 3)]
        if {"transform", "transforms"} & set(words(call_name(node))):  # its further operations are unknown
            return []
        if call_name(node) in ("reshape", "view", "flatten", "mv", "mm", "matmul"):
            return shape_vote(node)
        inner: List[cst.CSTNode] = [node.func.value] if isinstance(node.func, cst.Attribute) else []
        inner += arguments(node)[0][:1]
        votes = [vote for part in inner for vote in _votes(training, function, part, seen, depth + 1)]
        swap = swapped_axes(node)
        return votes if swap is None else [vote._replace(axis=swap.get(vote.axis, vote.axis)) for vote in votes]
    if isinstance(node, cst.Subscript):
        votes.extend(_uses(function, node))
        votes.extend(slice_vote(node))
        votes.extend(_votes(training, function, node.value, seen, depth + 1))
        return votes
    if isinstance(node, cst.BinaryOperation):
        for side in (node.left, node.right):
            axis = added_axis(function, side)
            if axis is not None:
                votes.append(Vote(axis, 2))
            else:
                votes.extend(_votes(training, function, side, seen, depth + 1))
        return votes
    if isinstance(node, (cst.Name, cst.Attribute)):
        votes.extend(_uses(function, node))
        for definition in sorted(function.flow.reaching(node), key=lambda d: d.order):
            if definition.kind == "parameter":
                votes.extend(_votes_of_callers(training, function, definition.place, seen, depth))
            if definition.value is None:
                continue
            if definition.kind == "element" and isinstance(definition.value, cst.Call):
                # a call is evidence for its first element only
                if not definition.index and call_name(definition.value) in CHANNELS_LAST:
                    votes.append(Vote(LAST, 2))
            elif definition.kind in ("assign", "augment"):
                votes.extend(_votes(training, function, definition.value, seen, depth + 1))
            elif definition.kind == "mutate" and isinstance(definition.value, cst.Call):  # images.append(image)
                for given in arguments(definition.value)[0]:
                    votes.extend(_votes(training, function, given, seen, depth + 1))
    return votes


def _is_picture(function: Function, node: cst.CSTNode) -> bool:
    """Return whether Pillow opened it, ``Image.open(path).resize(size)``: [H, W, C] as an array."""
    for part in attribute_chain(node):
        if isinstance(part, cst.Attribute) and dotted(part) == "Image.open":
            return True
        if isinstance(part, cst.Name):
            made = function.flow.reaching(part)
            opened = [
                d.value for d in made if d.kind in ("assign", "with") and d.value is not None and d.value is not node
            ]
            return bool(made) and len(opened) == len(made) and all(_is_picture(function, value) for value in opened)
    return False


def _votes_of_callers(training: Training, function: Function, name: str, seen: Set[int], depth: int) -> List[Vote]:
    """Return votes for a parameter: those of its arguments where training calls the function."""
    votes: List[Vote] = []
    for caller, call in training.sites.get(function, [])[:4]:
        value = function.given(call, name)
        if value is not None:
            votes.extend(_votes(training, caller, value, seen, depth + 1))
    return votes


def _votes_of_callees(training: Training, function: Function, images: Tuple[cst.CSTNode, ...]) -> List[Vote]:
    """Return votes from a function of the codebase that takes both images, such as SSIM."""
    votes: List[Vote] = []
    wanted = {squeezed(image) for image in images}
    for scope in _beside(function):
        for call in scope.flow.calls:
            positional, keywords, starred = arguments(call)
            if starred or len(positional) + len(keywords) < len(wanted):
                continue
            given = [squeezed(_without_batch(value)) for value in (*positional, *keywords.values())]
            if not wanted <= set(given):
                continue
            references = [r for r in training.program.resolve(scope, call.func) if not r.guess]
            for callee in [each for reference in references for each in training.program.run_by(reference)]:
                for name, value in zip((*callee.parameters[: len(positional)], *keywords), given):
                    if value in wanted:
                        votes.extend(_of_parameter(callee, name))
    return votes


def _without_batch(node: cst.CSTNode) -> cst.CSTNode:
    """Return ``image`` of ``image.unsqueeze(0)``."""
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and call_name(node) == "unsqueeze":
        positional = arguments(node)[0]
        return node.func.value if len(positional) == 1 and constant(positional[0]) == 0 else node
    return node


def _beside(function: Function) -> List[Function]:
    """Return the function, and for a nested one its neighbours with the same parameter."""
    parent = function.parent
    if parent is None or parent.parent is None:
        return [function]
    same_names = [f for f in parent.inner if f.parent is parent and f.parameters == function.parameters]
    return [function, *(f for f in same_names if f is not function)]


def _of_parameter(function: Function, name: str) -> List[Vote]:
    """Return votes for a parameter's layout, from what the function does with it on every path."""
    given = frozenset(d for d in function.flow.definitions.get(name, []) if d.kind == "parameter")
    certain = [line for line in function.body.body if isinstance(line, cst.SimpleStatementLine)]
    calls = [part for line in certain for part in walk_expressions(line) if isinstance(part, cst.Call)]
    return list(permuted(function, calls, name, given)) if given else []


def _uses(function: Function, node: cst.CSTNode) -> List[Vote]:
    """Return votes from other uses of the value: a permutation for SSIM shows the layout before."""
    place, definitions = path_of(node), function.flow.reaching(node)
    if place is None or (isinstance(node, cst.Name) and not definitions):
        return []
    return list(permuted(function, function.flow.calls, place, definitions))
