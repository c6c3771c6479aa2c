"""Walk the graph of a backward pass: what is made of a difference, and which leaves it leads to."""

from __future__ import annotations

import re
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Set, Tuple

KEY = "legs_loss"  # under which a node's metadata keeps its record
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


class Graph(NamedTuple):
    """The nodes under the roots of a backward pass, which nodes use each, and which of the leaves it leads to."""

    nodes: Dict[int, Any]
    users: Dict[int, List[Any]]
    variables: List[Any]
    masks: Dict[int, int]

    @classmethod
    def under(cls, roots: Iterable[Any]) -> Graph:
        """Walk from the roots' nodes; a node's Python object stays the same while the graph is held."""
        graph = cls({}, {}, [], {})
        path: List[Tuple[Any, Iterator[Any]]] = []
        for root in roots:
            graph._enter(root, path)
            while path:
                node, belows = path[-1]
                below = next(belows, None)
                if below is None:
                    path.pop()
                    graph.masks[id(node)] = graph._mask(node)
                elif below[0] is not None:
                    graph.users.setdefault(id(below[0]), []).append(node)
                    graph._enter(below[0], path)
        return graph

    def _enter(self, node: Any, path: List[Tuple[Any, Iterator[Any]]]) -> None:
        if node is not None and id(node) not in self.nodes:
            self.nodes[id(node)] = node
            path.append((node, iter(node.next_functions)))

    def _mask(self, node: Any) -> int:
        """Return a bit for each leaf under a node whose nodes below are known."""
        variable = getattr(node, "variable", None)  # of an AccumulateGrad
        if variable is not None:
            self.variables.append(variable)
            return 1 << len(self.variables) - 1
        found = 0
        for below, _ in node.next_functions:
            found |= self.masks[id(below)] if below is not None else 0
        return found

    def records(self) -> Dict[int, Any]:
        """Return the records of the differences among the nodes, by the node's id."""
        return {at: node.metadata[KEY] for at, node in self.nodes.items() if KEY in node.metadata}

    def leaves(self, at: int) -> List[Any]:
        """Return the leaves under a node."""
        return [leaf for bit, leaf in enumerate(self.variables) if self.masks[at] >> bit & 1]

    def foreign(self) -> Set[str]:
        """Return the names of the nodes that are not torch's own: fused kernels, whose differences cannot be seen."""
        return {name for name in (node.name() for node in self.nodes.values()) if not _OWN_NODE.search(name)}

    def made_of(self, at: int) -> str:
        """Return what is made of a difference: "l1", "squared", "robust" (both, or a bent l1), or "signed"."""
        kinds: Set[str] = set()
        seen: Set[int] = set()
        left = [(self.nodes[at], "signed", False)]
        while left:
            node, kind, is_reduced = left.pop()
            above = self.users.get(id(node), [])
            if not above:
                kinds.add(kind)
            for user in above:
                new, reduced = _after(node, user, kind, is_reduced)
                if new is None:
                    kinds.add(kind)
                elif id(user) not in seen:
                    seen.add(id(user))
                    left.append((user, new, reduced))
        kinds = kinds - {"signed"} or kinds
        return next(iter(kinds)) if len(kinds) == 1 else "robust"


def _after(node: Any, user: Any, kind: str, is_reduced: bool) -> Any:
    """Return what a node makes of a difference, and whether it was averaged; None where it is carried no further."""
    name = user.name()
    if is_reduced:
        return None, True
    if name.startswith("Abs"):
        return ("l1" if kind == "signed" else kind), False
    if name.startswith(("LinalgVectorNorm", "Norm")):
        order = getattr(user, "_saved_ord", getattr(user, "_saved_p", 2))
        return ("l1" if order == 1 else "squared"), False
    twice = sum(1 for below, _ in user.next_functions if below is node) > 1
    if (name.startswith("Mul") and twice) or name.startswith(("Pow", "Square")):
        return ("squared" if kind == "signed" else "robust"), False
    if name.startswith(_BENDS):
        return "robust", False
    if name.startswith("Add") and kind == "squared":  # of Charbonnier's epsilon
        return kind, False
    if name.startswith(_CARRIES):
        return kind, name.startswith(_REDUCES)
    return None, True
