"""Where the channel stands in an image, from the code around it: [C, H, W] as in 3DGS, or [H, W, C] as in gsplat."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.module import Function
from legs_adapters.reading.syntax import arguments, call_name, constant
from legs_adapters.reading.training import Training

__all__ = ["is_channels_last"]

_TO_LAST = {(1, 2, 0), (0, 2, 3, 1)}
_TO_FIRST = {(2, 0, 1), (0, 3, 1, 2)}
_LAST_RENDERERS = {"rasterization", "rasterization_2dgs", "rasterize_gaussians", "rasterization_inria_wrapper"}
_FIRST, _LAST = -3, -1


class Vote(NamedTuple):
    """A sign that the channels are on an axis, -3 to -1 (on the way between two transpositions also -2)."""

    axis: int
    strength: int


def is_channels_last(training: Training, function: Function, *images: cst.CSTNode) -> bool:
    """Return whether the images are [H, W, C] or [B, H, W, C]; without a sign of it they are not."""
    votes = [vote for image in images for vote in _votes(training, function, image, set(), 0)]
    last, first = (sum(vote.strength for vote in votes if vote.axis == axis) for axis in (_LAST, _FIRST))
    return last > first


def _votes(training: Training, function: Function, node: cst.CSTNode, seen: Set[int], depth: int) -> List[Vote]:
    if depth > 10 or id(node) in seen:
        return []
    seen.add(id(node))
    votes: List[Vote] = []
    if isinstance(node, cst.Call):
        order = _permutation(node)
        if order in _TO_LAST:
            return [Vote(_LAST, 3)]
        if order in _TO_FIRST:
            return [Vote(_FIRST, 3)]
        pattern = _pattern(node)
        if pattern is not None:
            after = pattern.split("->")[-1].split()
            return [Vote(_LAST if after[-1:] == ["c"] else _FIRST, 3)]
        if call_name(node) in _LAST_RENDERERS:
            return [Vote(_LAST, 2)]
        if call_name(node) in ("reshape", "view", "flatten", "mv", "mm", "matmul"):
            return _shape_vote(node)
        inner: List[cst.CSTNode] = [node.func.value] if isinstance(node.func, cst.Attribute) else []
        inner += arguments(node)[0][:1]
        votes = [vote for part in inner for vote in _votes(training, function, part, seen, depth + 1)]
        swap = _swap(node)
        return votes if swap is None else [vote._replace(axis=swap.get(vote.axis, vote.axis)) for vote in votes]
    if isinstance(node, cst.Subscript):
        votes.extend(_slice_vote(node))
        votes.extend(_votes(training, function, node.value, seen, depth + 1))
        return votes
    if isinstance(node, cst.BinaryOperation):
        for side in (node.left, node.right):
            if isinstance(side, cst.Subscript) and _is_spread(side):
                votes.append(Vote(_LAST, 2))
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
                # what a call returns says something of its first element only
                if not definition.index and call_name(definition.value) in _LAST_RENDERERS:
                    votes.append(Vote(_LAST, 2))
            elif definition.kind in ("assign", "augment"):
                votes.extend(_votes(training, function, definition.value, seen, depth + 1))
    return votes


def _votes_of_callers(training: Training, function: Function, name: str, seen: Set[int], depth: int) -> List[Vote]:
    """A parameter lies as what it is given where training calls the function."""
    if name not in function.parameters:
        return []
    votes: List[Vote] = []
    for caller, call in training.sites.get(function, [])[:4]:
        positional, keywords, _ = arguments(call)
        position = function.parameters.index(name)
        value = keywords.get(name, positional[position] if position < len(positional) else None)
        if value is not None:
            votes.extend(_votes(training, caller, value, seen, depth + 1))
    return votes


def _uses(function: Function, node: cst.CSTNode) -> List[Vote]:
    """What else the function does with the same value: permuting it for SSIM tells how it lay before."""
    definitions = function.flow.reaching(node)
    if not definitions or not isinstance(node, cst.Name):
        return []
    found: List[Vote] = []
    for call in function.flow.calls:
        order, subject = _permutation(call), _subject(call)
        pattern = _pattern(call)
        if subject is None or not isinstance(subject, cst.Name) or subject.value != node.value:
            continue
        if not (function.flow.reaching(subject) & definitions):
            continue
        if order in _TO_FIRST:
            found.append(Vote(_LAST, 3))
        elif order in _TO_LAST:
            found.append(Vote(_FIRST, 3))
        elif call_name(call) in ("mean", "sum") and _reduced(call) is not None:  # a grey image, a norm of the channels
            found.append(Vote(_LAST if _reduced(call) == -1 else _FIRST, 1))
        elif pattern is not None:
            found.append(Vote(_LAST if pattern.split("->")[0].split()[-1:] == ["c"] else _FIRST, 3))
    return found


def _permutation(node: cst.Call) -> Optional[Tuple[int, ...]]:
    if call_name(node) not in ("permute", "transpose"):  # numpy's transpose takes all axes
        return None
    positional, keywords, _ = arguments(node)
    values = [constant(value) for value in positional]
    if "dims" in keywords:
        values.append(constant(keywords["dims"]))
    if values and isinstance(values[-1], tuple):
        order = values[-1]
    else:
        order = tuple(value for value in values if isinstance(value, int))
    rank = len(order)
    return tuple(i % rank for i in order) if rank in (3, 4) and all(isinstance(i, int) for i in order) else None


def _swap(node: cst.Call) -> Optional[Dict[int, int]]:
    """``x.transpose(-1, -2)``: which axis becomes which, counted from the last."""
    if call_name(node) not in ("transpose", "swapaxes", "swapdims"):
        return None
    axes = [constant(value) for value in arguments(node)[0][-2:]]
    if len(axes) != 2 or not all(isinstance(axis, int) for axis in axes):
        return None
    rank = 4 if 3 in axes else 3
    first, second = (axis if axis < 0 else axis - rank for axis in axes)
    return {first: second, second: first}


def _reduced(node: cst.Call) -> Optional[int]:
    """The one axis that ``x.mean(dim=-1)`` goes over, if it can only be the channels: the last, or the first."""
    positional, keywords, _ = arguments(node)
    values = [keywords[key] for key in ("dim", "axis") if key in keywords]
    if isinstance(node.func, cst.Attribute) and not (
        isinstance(node.func.value, cst.Name) and node.func.value.value == "torch"
    ):
        values += positional[:1]
    else:
        values += positional[1:2]
    axis = constant(values[0]) if values else None
    return axis if axis in (-1, 0, -3) and not isinstance(axis, bool) else None


def _subject(node: cst.Call) -> Optional[cst.CSTNode]:
    if (
        isinstance(node.func, cst.Attribute)
        and isinstance(node.func.value, cst.Name)
        and node.func.value.value in ("torch", "einops")
    ):
        return node.args[0].value if node.args else None
    if isinstance(node.func, cst.Attribute):
        return node.func.value
    return node.args[0].value if node.args else None


def _pattern(node: cst.Call) -> Optional[str]:
    if call_name(node) not in ("rearrange", "repeat", "reduce"):
        return None
    for value in arguments(node)[0][1:2]:
        text = constant(value)
        if isinstance(text, str) and "->" in text and "c" in text.split():
            return text
    return None


def _shape_vote(node: cst.Call) -> List[Vote]:
    """``x.reshape(height, width, 3)``: what stood where before does not count."""
    sizes = [constant(value) for value in arguments(node)[0]]
    sizes = list(sizes[0]) if len(sizes) == 1 and isinstance(sizes[0], tuple) else sizes
    if call_name(node) not in ("reshape", "view") or len(sizes) not in (3, 4):
        return []
    return [Vote(axis, 3) for axis in (_LAST, _FIRST) if sizes[axis] == 3][:1]


def _slice_vote(node: cst.Subscript) -> List[Vote]:
    parts = [element.slice for element in node.slice]
    spread = isinstance(parts[0], cst.Index) and isinstance(parts[0].value, cst.Ellipsis)
    last = parts[-1]
    if spread and len(parts) == 2 and isinstance(last, cst.Slice) and constant(last.upper) == 3:
        return [Vote(_LAST, 2)]
    first = parts[0]
    if isinstance(first, cst.Index) and constant(first.value, "") is None and len(parts) == 3:
        return [Vote(_FIRST, 2)]  # grey[None, :, :]
    if isinstance(first, cst.Slice) and constant(first.upper) == 3:
        return [Vote(_FIRST, 2)]
    if (
        len(parts) >= 2
        and isinstance(parts[1], cst.Slice)
        and constant(parts[1].upper) == 3
        and isinstance(first, cst.Slice)
    ):
        return [Vote(_FIRST, 2)]
    return []


def _is_spread(node: cst.Subscript) -> bool:
    """``mask[..., None]``: the channel is added at the end."""
    parts = [element.slice for element in node.slice]
    return (
        len(parts) >= 2
        and isinstance(parts[-1], cst.Index)
        and constant(parts[-1].value, "") is None
        and isinstance(parts[0], cst.Index)
        and isinstance(parts[0].value, cst.Ellipsis)
    )
