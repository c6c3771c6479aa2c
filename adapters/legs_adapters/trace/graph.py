"""Walk the graph of a backward pass: what is made of a difference, and which leaves it leads to."""

from __future__ import annotations

from typing import Any, Dict, Iterable, List, NamedTuple, Set

__all__ = ["KEY", "Graph"]

KEY = "legs_loss"  # under which a node's metadata keeps its record
# Nodes that carry a difference on, or weigh and average it: by the beginnings of their names.
_CARRIES = (
    "Alias", "AsStrided", "Cat", "Clamp", "Clone", "Contiguous", "Copy", "Div", "Expand", "Gather", "Index",
    "MaskedFill", "MaskedSelect", "Mean", "Mul", "NanToNum", "Nansum", "Neg", "Permute", "Repeat", "Reshape", "Select",
    "Slice", "Split", "Squeeze", "Stack", "Sum", "TBackward",
    "ToCopy", "Transpose", "Unbind", "Unsafe", "Unsqueeze", "View", "Where",
)  # fmt: skip
_REDUCES = ("Mean", "Sum", "Nansum")
_BENDS = ("Pow", "Log", "Exp", "Sqrt", "Rsqrt", "Reciprocal", "Tanh", "Sigmoid", "HuberLoss", "SmoothL1Loss", "Square")


class Graph(NamedTuple):
    """The nodes under the roots of a backward pass, and which nodes use each."""

    nodes: Dict[int, Any]
    users: Dict[int, List[Any]]

    @classmethod
    def under(cls, roots: Iterable[Any]) -> Graph:
        """Walk from the roots' nodes; a node's Python object stays the same while the graph is held."""
        nodes, users = {}, {}  # type: Dict[int, Any], Dict[int, List[Any]]
        left = [node for node in roots if node is not None]
        nodes.update((id(node), node) for node in left)
        while left:
            node = left.pop()
            for below, _ in node.next_functions:
                if below is None:
                    continue
                users.setdefault(id(below), []).append(node)
                if id(below) not in nodes:
                    nodes[id(below)] = below
                    left.append(below)
        return cls(nodes, users)

    def records(self) -> Dict[int, Any]:
        """Return the records of the differences among the nodes, by the node's id."""
        return {at: node.metadata[KEY] for at, node in self.nodes.items() if KEY in node.metadata}

    def leaves(self, at: int) -> Dict[int, Any]:
        """Return the leaves under a node, by their ids."""
        found, seen, left = {}, {at}, [self.nodes[at]]  # type: Dict[int, Any], Set[int], List[Any]
        while left:
            node = left.pop()
            variable = getattr(node, "variable", None)  # of an AccumulateGrad
            if variable is not None:
                found[id(variable)] = variable
            for below, _ in node.next_functions:
                if below is not None and id(below) not in seen:
                    seen.add(id(below))
                    left.append(below)
        return found

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
