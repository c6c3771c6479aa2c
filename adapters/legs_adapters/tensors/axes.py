"""Find which axes an operation moves, adds or reduces: permutations, swaps, einops patterns, indices with ``None``."""

from __future__ import annotations

from typing import Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.syntax import arguments, call_name, constant
from legs_adapters.tensors.operations import MODULES

__all__ = [
    "FIRST",
    "LAST",
    "TO_FIRST",
    "TO_LAST",
    "adds_batch_axis",
    "einops_pattern",
    "index_parts",
    "permutation",
    "reduced_axis",
    "subject",
    "swapped_axes",
    "unsqueezed_axis",
]

# The axis of the channels, counted from the last: [C, H, W] and [H, W, C].
FIRST, LAST = -3, -1
TO_LAST: Set[Tuple[int, ...]] = {(1, 2, 0), (0, 2, 3, 1)}
TO_FIRST: Set[Tuple[int, ...]] = {(2, 0, 1), (0, 3, 1, 2)}


def permutation(node: cst.Call) -> Optional[Tuple[int, ...]]:
    """Return the order of the axes after ``x.permute(2, 0, 1)``, of three or four; None for any other call."""
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


def swapped_axes(node: cst.Call) -> Optional[Dict[int, int]]:
    """Return which axis becomes which, counted from the last, in ``x.transpose(-1, -2)``."""
    if call_name(node) not in ("transpose", "swapaxes", "swapdims"):
        return None
    axes = [constant(value) for value in arguments(node)[0][-2:]]
    if len(axes) != 2 or not all(isinstance(axis, int) for axis in axes):
        return None
    rank = 4 if 3 in axes else 3
    first, second = (axis if axis < 0 else axis - rank for axis in axes)
    return {first: second, second: first}


def reduced_axis(node: cst.Call) -> Optional[int]:
    """Return the one axis that ``x.mean(dim=-1)`` reduces, if it can only be the channels: the last, or the first."""
    if call_name(node) not in ("mean", "sum"):
        return None
    positional, keywords, _ = arguments(node)
    values = [keywords[key] for key in ("dim", "axis") if key in keywords]
    if isinstance(node.func, cst.Attribute) and not (
        isinstance(node.func.value, cst.Name) and node.func.value.value in MODULES
    ):
        values += positional[:1]
    else:
        values += positional[1:2]
    axis = constant(values[0]) if values else None
    return axis if axis in (-1, 0, -3) and not isinstance(axis, bool) else None


def subject(node: cst.Call) -> Optional[cst.CSTNode]:
    """Return the tensor that a call operates on: the object of a method, the first argument of a function."""
    if (
        isinstance(node.func, cst.Attribute)
        and isinstance(node.func.value, cst.Name)
        and node.func.value.value in MODULES
    ):
        return node.args[0].value if node.args else None
    if isinstance(node.func, cst.Attribute):
        return node.func.value
    return node.args[0].value if node.args else None


def einops_pattern(node: cst.Call) -> Optional[str]:
    """Return the pattern of ``rearrange(x, "h w c -> c h w")``, if it names the channels."""
    if call_name(node) not in ("rearrange", "repeat", "reduce"):
        return None
    for value in arguments(node)[0][1:2]:
        text = constant(value)
        if isinstance(text, str) and "->" in text and "c" in text.split():
            return text
    return None


def adds_batch_axis(node: cst.Subscript) -> bool:
    """Return whether an index only adds an axis: ``x[None]``, ``x[None, ...]``, ``x[None, :, :, :]``."""
    parts = index_parts(node)
    return parts[0] is None and all(part in (..., ":") for part in parts[1:])


def unsqueezed_axis(node: cst.CSTNode) -> Optional[int]:
    """Return the channels' axis of ``mask.unsqueeze(-1)``: last; of ``colour.unsqueeze(-1).unsqueeze(-1)``: first."""
    count = 0
    while isinstance(node, cst.Call) and call_name(node) == "unsqueeze" and isinstance(node.func, cst.Attribute):
        if [constant(value) for value in arguments(node)[0]] != [-1]:
            return None
        node, count = node.func.value, count + 1
    return {1: LAST, 2: FIRST}.get(count)


def index_parts(node: cst.Subscript) -> List[object]:
    """Return an index as a list of ``None``, ``...``, ``":"`` and, for anything else, its node."""
    parts: List[object] = []
    for element in node.slice:
        part = element.slice
        if isinstance(part, cst.Slice):
            parts.append(":" if part.lower is part.upper is part.step is None else part)
        elif isinstance(part, cst.Index):
            what: object = ... if isinstance(part.value, cst.Ellipsis) else constant(part.value, part.value)
            parts.append(what)
    return parts
