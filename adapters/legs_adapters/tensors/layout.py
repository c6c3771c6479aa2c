"""Tell where the channels stand in an image, from the code around it: [C, H, W] as in 3DGS, [H, W, C] as in gsplat."""

from __future__ import annotations

from typing import FrozenSet, Iterator, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    call_name,
    constant,
    dotted,
    path_of,
    same,
    walk_expressions,
    words,
)
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
    swapped_axes,
    unsqueezed_axis,
)
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.operations import CHANNELS_LAST, KEEPS_AXES

__all__ = ["Vote", "is_channels_last", "lies_last"]


class Vote(NamedTuple):
    """A sign that the channels are on an axis, -3 to -1 (on the way between two transpositions also -2)."""

    axis: int
    strength: int


def is_channels_last(
    training: Training, function: Function, *images: cst.CSTNode, error: Optional[cst.CSTNode] = None
) -> bool:
    """Return whether the images are [H, W, C] or [B, H, W, C]; without a sign of it they are not.

    ``error`` is what has been made of them, on which a mask may be laid.
    """
    votes = [vote for image in _without_factor(*images) for vote in _votes(training, function, image, set(), 0)]
    votes += _votes_of_callees(training, function, images)
    axes = [_added(function, factor) for factor in _factors_of(function, error)]
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
    """Return ``image`` and ``gt`` of ``weight * image`` and ``weight * gt``: the weight says nothing of the layout."""
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
        if words(call_name(made)) == ("to", "tensor"):  # torchvision's: of a picture as of an array
            return [Vote(FIRST, 3)]
        if {"transform", "transforms"} & set(words(call_name(node))):  # what it may do besides is not known
            return []
        if call_name(node) in ("reshape", "view", "flatten", "mv", "mm", "matmul"):
            return _shape_vote(node)
        inner: List[cst.CSTNode] = [node.func.value] if isinstance(node.func, cst.Attribute) else []
        inner += arguments(node)[0][:1]
        votes = [vote for part in inner for vote in _votes(training, function, part, seen, depth + 1)]
        swap = swapped_axes(node)
        return votes if swap is None else [vote._replace(axis=swap.get(vote.axis, vote.axis)) for vote in votes]
    if isinstance(node, cst.Subscript):
        votes.extend(_uses(function, node))
        votes.extend(_slice_vote(node))
        votes.extend(_votes(training, function, node.value, seen, depth + 1))
        return votes
    if isinstance(node, cst.BinaryOperation):
        for side in (node.left, node.right):
            axis = _added(function, side)
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
                # what a call returns says something of its first element only
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
    """A parameter lies as what it is given where training calls the function."""
    votes: List[Vote] = []
    for caller, call in training.sites.get(function, [])[:4]:
        value = function.given(call, name)
        if value is not None:
            votes.extend(_votes(training, caller, value, seen, depth + 1))
    return votes


def _votes_of_callees(training: Training, function: Function, images: Tuple[cst.CSTNode, ...]) -> List[Vote]:
    """Pictures that go together into a function of the codebase lie as it takes them, for SSIM as for the L1."""
    votes: List[Vote] = []
    for scope in _beside(function):
        for call in scope.flow.calls:
            positional, keywords, starred = arguments(call)
            given = [_without_batch(value) for value in (*positional, *keywords.values())]
            if starred or not all(any(same(value, image) for value in given) for image in images):
                continue
            references = [r for r in training.program.resolve(scope, call.func) if not r.guess]
            for callee in [each for reference in references for each in training.program.run_by(reference)]:
                for name, value in zip((*callee.parameters[: len(positional)], *keywords), given):
                    if any(same(value, image) for image in images):
                        votes.extend(_of_parameter(callee, name))
    return votes


def _without_batch(node: cst.CSTNode) -> cst.CSTNode:
    """Return ``image`` of ``image.unsqueeze(0)``."""
    if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute) and call_name(node) == "unsqueeze":
        positional = arguments(node)[0]
        return node.func.value if len(positional) == 1 and constant(positional[0]) == 0 else node
    return node


def _beside(function: Function) -> List[Function]:
    """Return the function, and where it is nested in another one those beside it that take the same."""
    parent = function.parent
    if parent is None or parent.parent is None:
        return [function]
    same_names = [f for f in parent.inner if f.parent is parent and f.parameters == function.parameters]
    return [function, *(f for f in same_names if f is not function)]


def _of_parameter(function: Function, name: str) -> List[Vote]:
    """Return votes for a parameter's layout, by what the function does with it in any case."""
    given = frozenset(d for d in function.flow.definitions.get(name, []) if d.kind == "parameter")
    certain = [line for line in function.body.body if isinstance(line, cst.SimpleStatementLine)]
    calls = [part for line in certain for part in walk_expressions(line) if isinstance(part, cst.Call)]
    return list(_permuted(function, calls, name, given)) if given else []


def _uses(function: Function, node: cst.CSTNode) -> List[Vote]:
    """Return votes by what else the function does with the value: permuting it for SSIM tells how it lay before."""
    place, definitions = path_of(node), function.flow.reaching(node)
    if place is None or (isinstance(node, cst.Name) and not definitions):
        return []
    return list(_permuted(function, function.flow.calls, place, definitions))


def _permuted(
    function: Function, calls: List[cst.Call], place: str, definitions: FrozenSet[Definition]
) -> Iterator[Vote]:
    """Yield what calls say that permute, or reduce, the value which a place has from these definitions."""
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
    """Return ``x`` of what is permuted, ``x.clip(0, 1)[None]``: only an axis for the batch has come before x's own.

    Of a product, ``x * mask``, each factor.
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


def _shape_vote(node: cst.Call) -> List[Vote]:
    """Return the vote of ``x.reshape(height, width, 3)``: what stood where before does not count."""
    sizes = [constant(value) for value in arguments(node)[0]]
    sizes = list(sizes[0]) if len(sizes) == 1 and isinstance(sizes[0], tuple) else sizes
    if call_name(node) not in ("reshape", "view") or len(sizes) not in (3, 4):
        return []
    return [Vote(axis, 3) for axis in (LAST, FIRST) if sizes[axis] == 3][:1]


def _slice_vote(node: cst.Subscript) -> List[Vote]:
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


def _added(function: Function, node: cst.CSTNode) -> Optional[int]:
    """Return where an image's channels are by the axes that are added to what is laid over it."""
    if isinstance(node, cst.Name):
        made = function.flow.assigned(node)
        return _added(function, made[0]) if len(made) == 1 and isinstance(made[0], (cst.Call, cst.Subscript)) else None
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
