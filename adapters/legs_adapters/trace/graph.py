"""Walk the graph of a backward pass: what is made of a difference, and which leaves it leads to."""

from __future__ import annotations

import re
from typing import Any, Dict, Iterable, List, Optional, Set

# Nodes that carry a difference on, or weigh and average it: by the beginnings of their names.
_CARRIES = (
    "Alias", "AsStrided", "Cat", "Clamp", "Clone", "Contiguous", "Copy", "Div", "Expand", "Gather", "Index",
    "MaskedFill", "MaskedSelect", "Mean", "Mul", "NanToNum", "Nansum", "Neg", "Permute", "Repeat", "Reshape", "Select",
    "Slice", "Split", "Squeeze", "Stack", "Sum", "TBackward",
    "ToCopy", "Transpose", "Unbind", "Unsafe", "Unsqueeze", "View", "Where",
)  # fmt: skip
_OWN_NODE = re.compile(r"Backward\d+$|AccumulateGrad$|CopyBackwards$|CopySlices$|GraphRoot$|^$")
_REDUCES = ("Mean", "Sum", "Nansum")
_BENDS = ("Pow", "Log", "Exp", "Sqrt", "Rsqrt", "Reciprocal", "Tanh", "Sigmoid", "HuberLoss", "SmoothL1Loss", "Square")

Users = Dict[Any, List[Any]]  # of each node those that use it; a node's Python object stays while the graph is held


def nodes_under(roots: Iterable[Any]) -> Users:
    """Return the nodes of the graph under some of them and these, as a walk down meets them, each with its users."""
    users: Users = {}
    left = [(root, None) for root in roots][::-1]
    while left:
        node, user = left.pop()
        if node is None:
            continue
        if node not in users:
            users[node] = []
            left += [(below, node) for below, _ in node.next_functions[::-1]]
        if user is not None:
            users[node].append(user)
    return users


def leaves_under(node: Any) -> List[Any]:
    """Return the leaves that a node leads to."""
    found = [getattr(below, "variable", None) for below in nodes_under([node])]  # of an AccumulateGrad
    return [leaf for leaf in found if leaf is not None]


def foreign(nodes: Users) -> Set[str]:
    """Return the names of the nodes that are not torch's own: fused kernels, whose differences cannot be seen."""
    return {name for name in (node.name() for node in nodes) if not _OWN_NODE.search(name)}


def made_of(node: Any, users: Users, kind: str) -> str:
    """Return what becomes of a "signed" difference or an "l1": one of these, "squared", or "robust" (both, or bent)."""
    kinds: Set[str] = set()
    seen: Set[Any] = set()
    left = [(node, kind)]
    while left:
        node, kind = left.pop()
        if not users[node]:
            kinds.add(kind)
        for user in users[node]:
            new = _after(node, user, kind)
            if new is None or user.name().startswith(_REDUCES):  # what becomes of an average does not matter
                kinds.add(new or kind)
            elif user not in seen:
                seen.add(user)
                left.append((user, new))
    kinds = kinds - {"signed"} or kinds
    return next(iter(kinds)) if len(kinds) == 1 else "robust"


def _after(node: Any, user: Any, kind: str) -> Optional[str]:
    """Return what a node makes of a difference; None where it is carried no further."""
    name = user.name()
    if name.startswith("Abs"):
        return "l1" if kind == "signed" else kind
    if name.startswith(("LinalgVectorNorm", "Norm")):
        return "l1" if getattr(user, "_saved_ord", getattr(user, "_saved_p", 2)) == 1 else "squared"
    twice = sum(1 for below, _ in user.next_functions if below is node) > 1
    if (name.startswith("Mul") and twice) or name.startswith(("Pow", "Square")):
        return "squared" if kind == "signed" else "robust"
    if name.startswith(_BENDS):
        return "robust"
    is_squared_plus = name.startswith("Add") and kind == "squared"  # Charbonnier's epsilon
    return kind if is_squared_plus or name.startswith(_CARRIES) else None
