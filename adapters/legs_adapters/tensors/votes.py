"""Read single operations as votes for the axis of an image's channels: a permutation, a slice, an added axis."""

from __future__ import annotations

from typing import FrozenSet, Iterator, List, NamedTuple, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import arguments, call_name, constant, path_of
from legs_adapters.tensors.axes import (
    FIRST,
    LAST,
    TO_FIRST,
    TO_LAST,
    adds_batch_axis,
    einops_pattern,
    index_parts,
    permutation,
    reduced_axis,
    subject,
    unsqueezed_axis,
)
from legs_adapters.tensors.operations import KEEPS_AXES

__all__ = ["Vote", "added_axis", "permuted", "shape_vote", "slice_vote"]


class Vote(NamedTuple):
    """A sign that the channels are on an axis, -3 to -1 (on the way between two transpositions also -2)."""

    axis: int
    strength: int


def shape_vote(node: cst.Call) -> List[Vote]:
    """Return the vote of ``x.reshape(height, width, 3)``, whatever the layout before."""
    sizes = [constant(value) for value in arguments(node)[0]]
    sizes = list(sizes[0]) if len(sizes) == 1 and isinstance(sizes[0], tuple) else sizes
    if call_name(node) not in ("reshape", "view") or len(sizes) not in (3, 4):
        return []
    return [Vote(axis, 3) for axis in (LAST, FIRST) if sizes[axis] == 3][:1]


def slice_vote(node: cst.Subscript) -> List[Vote]:
    """Return the vote of ``image[:3]``, ``image[..., :3]`` or ``grey[None, :, :]``."""
    parts = [element.slice for element in node.slice]
    spread = isinstance(parts[0], cst.Index) and isinstance(parts[0].value, cst.Ellipsis)
    last = parts[-1]
    if spread and len(parts) == 2 and isinstance(last, cst.Slice) and constant(last.upper) == 3:
        return [Vote(LAST, 2)]
    first = parts[0]
    if isinstance(first, cst.Index) and constant(first.value, "") is None and len(parts) == 3:
        return [Vote(FIRST, 2)]  # grey[None, :, :]
    if isinstance(first, cst.Slice) and constant(first.upper) == 3:
        return [Vote(FIRST, 2)]
    if (
        len(parts) >= 2
        and isinstance(parts[1], cst.Slice)
        and constant(parts[1].upper) == 3
        and isinstance(first, cst.Slice)
    ):
        return [Vote(FIRST, 2)]
    return []


def added_axis(function: Function, node: cst.CSTNode) -> Optional[int]:
    """Return the channel axis of an image, from the axes that are added to a mask or colour applied to it."""
    if isinstance(node, cst.Name):
        made = function.flow.assigned(node)
        return (
            added_axis(function, made[0]) if len(made) == 1 and isinstance(made[0], (cst.Call, cst.Subscript)) else None
        )
    if isinstance(node, cst.Call):
        return unsqueezed_axis(node)
    if not isinstance(node, cst.Subscript):
        return None
    parts = index_parts(node)
    if parts in ([None, None, ":"], [":", None, None, ":"]):
        return LAST  # colour[None, None, :]
    if parts[-2:] == [None, None] and len(parts) > 2:
        return FIRST  # colour[:, None, None]
    if parts[-1] is None and (parts[0] is ... or parts[:2] == [":", ":"]):
        return LAST  # mask[..., None]
    return FIRST if parts in ([":", None], [":", None, ":", ":"]) else None  # mask[:, None]


def permuted(
    function: Function, calls: List[cst.Call], place: str, definitions: FrozenSet[Definition]
) -> Iterator[Vote]:
    """Yield the votes of calls that permute or reduce the value of a place with these definitions."""
    for call in calls:
        order, pattern, axis = permutation(call), einops_pattern(call), reduced_axis(call)
        if order is None and pattern is None and axis is None:
            continue
        moved = next((part for part in _before(subject(call), order) if path_of(part) == place), None)
        if moved is None:
            continue
        reaching = function.flow.reaching(moved)
        if reaching != definitions and not reaching & definitions:
            continue
        if order in TO_FIRST:
            yield Vote(LAST, 3)
        elif order in TO_LAST:
            yield Vote(FIRST, 3)
        elif axis is not None:  # a grey image, a norm of the channels
            yield Vote(LAST if axis == -1 else FIRST, 1)
        elif pattern is not None:
            yield Vote(LAST if pattern.split("->")[0].split()[-1:] == ["c"] else FIRST, 3)


def _before(node: Optional[cst.CSTNode], order: Optional[Tuple[int, ...]]) -> List[cst.CSTNode]:
    """Return ``x`` of a permuted ``x.clip(0, 1)[None]``, where at most a batch axis was added.

    For a product, ``x * mask``, return each factor.
    """
    while node is not None:
        if isinstance(node, cst.Call) and call_name(node) in KEEPS_AXES:
            node = subject(node)
        elif isinstance(node, cst.Call) and call_name(node) == "unsqueeze" and order is not None:
            if constant(node.args[-1].value if node.args else None) != 0 or len(order) != 4:
                return []
            node = subject(node)
        elif isinstance(node, cst.Subscript) and order is not None and len(order) == 4 and adds_batch_axis(node):
            node = node.value
        elif isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Multiply) and order is not None:
            return [*_before(node.left, order), *_before(node.right, order)]
        else:
            return [node]
    return []
