"""Recognise the L1 functions of a codebase: they use their first two parameters in differences only."""

from __future__ import annotations

import re
from typing import Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.returned import known_arguments, returned
from legs_adapters.code.syntax import arguments, call_name, code, constant, key_of, walk_expressions
from legs_adapters.lexicon.names import TORCH_L1, is_l1_name
from legs_adapters.lexicon.words import SPEAKS_OF_LOSS
from legs_adapters.tensors.absolute import abs_argument, is_abs, mean_of
from legs_adapters.tensors.operations import ASKS, LIKE, OTHER_LOSSES, SIZES, TRANSFORMS, TRANSPARENT, depends
from legs_adapters.terms.prospects import Prospects

__all__ = ["L1Functions"]

_GSPLAT_L1 = re.compile(r"^gsplat\.losses\.l1_loss$")
_TORCH_MODULE = re.compile(r"(^|\.)L1Loss$")  # nerfstudio hands torch's on


class L1Functions:
    """The L1 functions of one program: its own, and torch's.

    Args:
        program: the program.
        prospects: which text can lead to an L1 at all.
    """

    def __init__(self, program: Program, prospects: Prospects) -> None:
        self.program = program
        self._prospects = prospects
        self._only: Dict[Function, bool] = {}
        self._uncalled: Dict[Function, Optional[str]] = {}  # shapes, whatever a call may give

    def shape(self, function: Function, call: Optional[cst.Call] = None, depth: int = 0) -> Optional[str]:
        """Return what a function of the checkout computes from its first two arguments.

        Args:
            call: a call of it: arguments that are missing have their defaults.

        Returns:
            "mean" for ``abs(a - b).mean()``, "none" for ``abs(a - b)``, "own" for any other L1 that depends on
            the difference (and on further arguments) only; None where it is not an L1.
        """
        if call is None and depth == 0:  # each of a function's terms asks it
            if function not in self._uncalled:
                self._uncalled[function] = self._shape(function, None, 0)
            return self._uncalled[function]
        return self._shape(function, call, depth)

    def _shape(self, function: Function, call: Optional[cst.Call], depth: int) -> Optional[str]:
        names = function.parameters
        if len(names) < 2 or depth > 4 or not self._prospects.of(function.text):
            return None
        a, b = names[:2]
        if not self._only_differences(function, a, b, depth):
            return None
        if set(function.decorators) - TRANSPARENT:
            return "own"  # the decorator may change what is returned: a mean, a weight
        known = known_arguments(function, call)
        value = returned(function, known)
        if value is not None:
            shape = self._shape_of(function, value, a, b, depth)
            if shape is not None:
                return shape
        return "own" if SPEAKS_OF_LOSS.search(function.name) or function.runs_by_instance else None

    def shape_of_reference(self, reference: Reference, node: cst.Call) -> Optional[str]:
        """Return what `shape` does for the function of a call, torch's functions included."""
        if reference.kind == "external":
            name = str(reference.target)
            if _GSPLAT_L1.match(name):
                return "none"
            if TORCH_L1.search(name):
                return "own"
            return "own" if is_l1_name(name.split(".")[-1]) and not name.endswith("L1Loss") else None
        if reference.kind == "made by":
            return "own" if _TORCH_MODULE.search(str(reference.target)) else None
        if reference.kind == "function" and isinstance(reference.target, Function):
            return self.shape(reference.target, node)
        if reference.kind == "instance":
            methods = self.program.member(reference.target, "forward")  # type: ignore[arg-type]
            if len(methods) == 1 and isinstance(methods[0].target, Function):
                return "own" if self.shape(methods[0].target, node) else None
        return None

    def is_l1(self, function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
        """Return whether an expression is an L1 function, torch's or the codebase's own."""

        def known(reference: Reference) -> bool:
            if isinstance(reference.target, Function):
                return not reference.guess and self.shape(reference.target, None, depth + 1) is not None
            return reference.kind == "external" and TORCH_L1.search(str(reference.target)) is not None

        references = self.program.resolve(function, node)
        return bool(references) and all(map(known, references))

    def _shape_of(self, function: Function, node: cst.CSTNode, a: str, b: str, depth: int) -> Optional[str]:
        if not isinstance(node, cst.Call):
            return None
        meant = mean_of(node)
        argument = abs_argument(meant if meant is not None else node)
        if isinstance(argument, cst.BinaryOperation) and isinstance(argument.operator, cst.Subtract):
            if {code(argument.left).strip("() "), code(argument.right).strip("() ")} == {a, b}:
                return "mean" if meant is not None else "none"
            return None
        positional, keywords, starred = arguments(node)
        if [code(value) for value in positional[:2]] != [a, b] or starred:
            return None
        references = self.program.resolve(function, node.func)
        if len(references) != 1:
            return None
        reference = references[0]
        if reference.kind == "external" and TORCH_L1.search(str(reference.target)) and len(positional) == 2:
            return "none" if list(keywords) == ["reduction"] and constant(keywords["reduction"]) == "none" else None
        if reference.kind == "function" and isinstance(reference.target, Function) and len(node.args) == 2:
            shape = self.shape(reference.target, node, depth + 1)
            return shape if shape in ("mean", "none") else None
        return None

    def _only_differences(self, function: Function, a: str, b: str, depth: int) -> bool:
        """Return whether a function uses its first two parameters in differences only."""
        if function not in self._only:
            self._only[function] = False  # for recursion
            self._only[function] = self._meet_in_differences(function, a, b, depth)
        return self._only[function]

    def _meet_in_differences(self, function: Function, a: str, b: str, depth: int) -> bool:
        assert isinstance(function.node, cst.FunctionDef)
        nodes: List[cst.CSTNode] = []
        for statement in function.body.body:
            nodes.extend(walk_expressions(statement))
        pairs, allowed = _picked_pairs(function, nodes, a, b)
        absolute = False
        changed: List[Tuple[str, cst.CSTNode, cst.BaseExpression]] = []

        def mirrored(left: cst.BaseExpression, right: cst.BaseExpression) -> bool:
            return any(_mirrored(left, right, *pair) for pair in pairs)

        for node in nodes:
            if isinstance(node, cst.BinaryOperation):
                if isinstance(node.operator, cst.Power) and depends(function, node.left, {a, b}):
                    return False
                if isinstance(node.operator, cst.Multiply) and constant(node.right, 1) == 0:
                    allowed.update(id(n) for n in walk_expressions(node))
                if isinstance(node.operator, cst.Subtract) and mirrored(node.left, node.right):
                    if self._is_made_by(function, node.left):
                        return False  # edges(a) - edges(b): of what is made of the two
                    allowed.update(id(n) for n in walk_expressions(node))
            elif isinstance(node, cst.Call):
                name = call_name(node)
                if name in TRANSFORMS | OTHER_LOSSES:
                    return False
                if name in ASKS | LIKE:
                    allowed.update(id(n) for arg in node.args for n in walk_expressions(arg))
                absolute = absolute or is_abs(node)
                positional = arguments(node)[0]
                spread = any(arg.star == "*" for arg in node.args)
                pair = len(positional) >= 2 and not spread and mirrored(positional[0], positional[1])
                if pair and (
                    any(
                        self._is_l1_reference(function, r, node, depth)
                        for r in self.program.resolve(function, node.func)
                    )
                    or any(self._is_handed_l1(function, value, depth) for value in positional[2:])
                ):
                    allowed.update(id(n) for value in positional[:2] for n in walk_expressions(value))
                    absolute = True
            elif isinstance(node, cst.Comparison):
                # A mask made from the second, `gt != 0`: it is handed over as it is.
                allowed.update(id(n) for n in walk_expressions(node) if isinstance(n, cst.Name) and n.value == b)
            elif isinstance(node, cst.Attribute) and node.attr.value in SIZES:
                allowed.add(id(node.value))
            elif isinstance(node, cst.Subscript) and isinstance(node.value, cst.Name) and isinstance(key_of(node), str):
                if node.value.value in (a, b):
                    return False  # what is compared is in them: no pictures themselves
            elif isinstance(node, (cst.Assign, cst.AugAssign)):
                # `a = a[mask]`, then `b = b[mask]`, is as good as a mask on the difference.
                targets = [t.target for t in node.targets] if isinstance(node, cst.Assign) else [node.target]
                taken = [t.value for t in targets if isinstance(t, cst.Name) and t.value in (a, b)]
                if taken and (isinstance(node, cst.AugAssign) or len(targets) != 1):
                    return False
                if taken:
                    changed.append((taken[0], targets[0], node.value))
        if not absolute or len(changed) % 2:
            return False
        beside = [
            each.value for value in function.flow.returns if isinstance(value, cst.Tuple) for each in value.elements
        ]
        if not all(depends(function, each, {a, b}) for each in beside):
            return False  # return loss, mask
        for (one, target, value), (other, other_target, other_value) in zip(changed[::2], changed[1::2]):
            if {one, other} != {a, b} or not _mirrored(value, other_value, a, b):
                return False
            for part in (target, value, other_target, other_value):
                allowed.update(id(n) for n in walk_expressions(part))
        compared = {name for pair in pairs for name in pair}
        names = [node for node in nodes if isinstance(node, cst.Name) and node.value in compared]
        return bool(names) and all(id(node) in allowed for node in names)

    def _is_l1_reference(self, function: Function, reference: Reference, node: cst.Call, depth: int) -> bool:
        if reference.kind == "made by" and not function.runs_by_instance:
            return False  # self.l1_loss(...) in a method of its name: there it is the term itself
        if reference.kind == "function" and isinstance(reference.target, Function):
            return self.shape(reference.target, node, depth + 1) is not None
        return reference.kind in ("external", "made by") and self.shape_of_reference(reference, node) is not None

    def _is_handed_l1(self, function: Function, node: cst.BaseExpression, depth: int) -> bool:
        """Return whether an argument is an L1 function itself, as in ``masked_loss(pred, gt, l1, mask=mask)``."""
        return isinstance(node, cst.Name) and self.is_l1(function, node, depth)

    def _is_made_by(self, function: Function, node: cst.CSTNode) -> bool:
        """Return whether an expression calls a function of the codebase."""
        calls = [part for part in walk_expressions(node) if isinstance(part, cst.Call)]
        return any(
            r.kind == "function" and not r.guess for call in calls for r in self.program.resolve(function, call.func)
        )


def _picked_pairs(
    function: Function, nodes: List[cst.CSTNode], a: str, b: str
) -> Tuple[List[Tuple[str, str]], Set[int]]:
    """Return the two parameters and equal selections of both, ``x = a[:, mask]``, ``y = b[:, mask]``.

    Returns:
        Those pairs of names, and the ids of the assignments' parts.
    """
    pairs, parts = [(a, b)], set()
    picked: List[Tuple[str, cst.Assign]] = []
    for node in nodes:
        if isinstance(node, cst.Assign) and len(node.targets) == 1 and isinstance(node.value, cst.Subscript):
            target = node.targets[0].target
            if isinstance(target, cst.Name) and len(function.flow.definitions.get(target.value, [])) == 1:
                picked.append((target.value, node))
    for (one, first), (other, second) in zip(picked, picked[1:]):
        of = [node.value.value for node in (first, second) if isinstance(node.value, cst.Subscript)]
        texts = [code(part) for part in of]
        if sorted(texts) == sorted([a, b]) and _mirrored(first.value, second.value, a, b):
            pairs.append((one, other) if texts[0] == a else (other, one))
            parts |= {id(part) for node in (first, second) for part in walk_expressions(node)}
    return pairs, parts


def _mirrored(left: cst.BaseExpression, right: cst.BaseExpression, a: str, b: str) -> bool:
    """Return whether two expressions are equal except for ``a`` in one and ``b`` in the other."""
    swap = re.compile(rf"\b({re.escape(a)}|{re.escape(b)})\b")
    texts = [re.sub(r"\s+", "", code(node)).strip("()") for node in (left, right)]
    found = [swap.findall(text) for text in texts]
    if not found[0] or not found[1] or len(set(found[0])) != 1 or len(set(found[1])) != 1 or found[0][0] == found[1][0]:
        return False
    return swap.sub("?", texts[0]) == swap.sub("?", texts[1])
