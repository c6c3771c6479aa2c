"""Recognise the L1 functions of a codebase: they use their first two parameters in differences only."""

from __future__ import annotations

import ast
import re
from typing import Dict, List, NamedTuple, Optional, Sequence, Set, Tuple

from legs_adapters.code.module import CALLED, Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.returned import returned
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    code,
    constant,
    dotted,
    given,
    key_of,
    name_of,
    walk_expressions,
)
from legs_adapters.lexicon.names import TORCH_L1, has_perceptual_name, is_l1_name
from legs_adapters.lexicon.words import SPEAKS_OF_LOSS
from legs_adapters.tensors.absolute import abs_argument, absolute_value, sides_of
from legs_adapters.tensors.operations import ASKS, LIKE, LIMITS, OTHER_LOSSES, SIZES, TRANSFORMS, TRANSPARENT, depends
from legs_adapters.terms.writing import PACKAGE

_DEPTH = 4


class _Body(NamedTuple):
    """A function's body.

    Attributes:
        pairs: its first two parameters, and the names of equal selections of both.
    """

    function: Function
    pairs: Sequence[Tuple[str, str]]
    depth: int

    def is_pair(self, left: ast.AST, right: ast.AST) -> bool:
        """Return whether two expressions are the same of the one and of the other."""
        return any(_are_mirrored(left, right, *pair) for pair in self.pairs)


class L1Functions:
    """The L1 functions of one program: its own, and torch's.

    Args:
        program: the program.
    """

    def __init__(self, program: Program) -> None:
        self.program = program
        self._only: Dict[Function, bool] = {}

    def shape(self, function: Function, depth: int = 0) -> Optional[str]:
        """Return what a function of the checkout, so many calls deep, computes from its first two arguments.

        Returns:
            "mean" for ``abs(a - b).mean()``, "none" for ``abs(a - b)``, "own" for any other L1 that depends on
            the difference (and on further arguments) only; None where it is not an L1.
        """
        if len(function.parameters) < 2 or depth > _DEPTH:
            return None
        if function not in self._only:
            self._only[function] = False  # for recursion
            self._only[function] = self._compares_only(function, depth)
        if not self._only[function]:
            return None
        if set(function.decorators) - TRANSPARENT:
            return "own"  # the decorator may change what is returned: a mean, a weight
        value = returned(function)
        shape = self._shape_of(function, value, depth) if isinstance(value, ast.Call) else None
        return shape or ("own" if SPEAKS_OF_LOSS.search(function.name) or function.name in CALLED else None)

    def _shape_of(self, function: Function, node: ast.Call, depth: int) -> Optional[str]:
        """Return what a returned call makes of the two: "mean" or "none", None for anything else."""
        pair, found = function.parameters[:2], absolute_value(node)
        sides = sides_of(found.argument) if found is not None else None
        if found is not None and sides is not None:
            return found.makes if {code(side).strip("() ") for side in sides} == set(pair) else None
        references = self.program.resolve(function, node.func)
        if [code(arg.value) for arg in given(node)[:2]] != pair or len(references) != 1:
            return None
        if TORCH_L1.search(str(references[0].target)):
            settings = [(arg.keyword, constant(arg.value)) for arg in given(node)[2:]]
            return "none" if settings == [("reduction", "none")] else None
        shape = self.shape_of_reference(references[0], depth + 1) if len(given(node)) == 2 else None
        return shape if shape != "own" else None

    def shape_of_reference(self, reference: Reference, depth: int = 0) -> Optional[str]:
        """Return what `shape` does for what is called, torch's functions included."""
        name = str(getattr(reference.target, "name", reference.target))
        if has_perceptual_name(name.split(".")[-1]) or name.startswith(f"{PACKAGE}."):
            return None  # whatever its body: an L1 of features; or weighted before
        if reference.kind == "external" and name == "gsplat.losses.l1_loss":
            return "none"
        if reference.kind == "external":
            is_l1 = is_l1_name(name.split(".")[-1]) and not name.endswith("L1Loss")
            return "own" if is_l1 or TORCH_L1.search(name) else None
        if reference.kind == "made by":
            return "own" if name.split(".")[-1] == "L1Loss" else None  # nerfstudio hands torch's on
        if reference.kind == "function" and isinstance(reference.target, Function):
            return self.shape(reference.target, depth)
        if reference.kind == "instance" and depth == 0:
            methods = self.program.member(reference.target, "forward")  # type: ignore[arg-type]
            if len(methods) == 1 and isinstance(methods[0].target, Function):
                return "own" if self.shape(methods[0].target) else None
        return None

    # -- what a body may do with the two

    def _compares_only(self, function: Function, depth: int) -> bool:
        """Return whether a function takes an L1 of its first two parameters, and does nothing else with them."""
        nodes = [node for statement in function.body for node in walk_expressions(statement)]
        pairs, selecting = _selected(function, nodes)
        body, allowed = _Body(function, pairs, depth), set(selecting)
        for node in nodes:
            parts = self._may_have(body, node)
            if parts is None:
                return False
            allowed.update(id(part) for each in parts for part in walk_expressions(each))
        if any(isinstance(value, ast.Tuple) for value in function.flow.returns):
            return False  # return loss, mask
        compared = {name for pair in pairs for name in pair}
        names = [node for node in nodes if name_of(node) in compared]
        absolute = any(isinstance(node, ast.Call) and (abs_argument(node) or self._is_l1(body, node)) for node in nodes)
        return absolute and bool(names) and all(id(node) in allowed for node in names)

    def _may_have(self, body: _Body, node: ast.AST) -> Optional[Sequence[ast.AST]]:
        """Return the parts of a node in which it may have the two; None where the function is no L1."""
        sides = sides_of(node)
        if sides is not None and body.is_pair(*sides):
            return self._in_difference(body, node, sides[0])
        if isinstance(node, ast.BinOp):
            return self._in_operation(body, node)
        if isinstance(node, ast.Call):
            return self._in_call(body, node)
        if isinstance(node, ast.Attribute) and node.attr in SIZES:
            return [node.value]
        if isinstance(node, ast.Compare) and all(depends(body.function, node, {name}) for name in body.pairs[0]):
            return None  # a threshold of the difference: a weight would move pixels over it
        if isinstance(node, ast.Subscript) and dotted(node.value) in body.pairs[0] and isinstance(key_of(node), str):
            return None  # an entry of a dictionary: its parameter is no picture itself
        return []

    def _in_difference(self, body: _Body, node: ast.AST, side: ast.AST) -> Optional[List[ast.AST]]:
        calls = [part for part in walk_expressions(side) if isinstance(part, ast.Call)]
        if LIMITS & set(map(call_name, calls)):
            return None  # a weighted difference would be cut off
        made = [r for call in calls for r in self.program.resolve(body.function, call.func)]
        return None if any(r.kind == "function" for r in made) else [node]  # edges(a) - edges(b)

    def _in_operation(self, body: _Body, node: ast.BinOp) -> Optional[List[ast.AST]]:
        if isinstance(node.op, ast.Pow) and depends(body.function, node.left, set(body.pairs[0])):
            return None
        return [node] if isinstance(node.op, ast.Mult) and constant(node.right, 1) == 0 else []

    def _in_call(self, body: _Body, node: ast.Call) -> Optional[List[ast.AST]]:
        if call_name(node) in TRANSFORMS | OTHER_LOSSES:
            return None
        if call_name(node) in ASKS | LIKE:
            return [*node.args, *node.keywords]
        return [*node.args[:2]] if self._is_l1(body, node) else []

    def _is_l1(self, body: _Body, node: ast.Call) -> bool:
        """Return whether a call is of an L1 with both, torch's or the codebase's own."""
        positional = arguments(node)[0]
        spread = any(isinstance(arg, ast.Starred) for arg in node.args)
        if len(positional) < 2 or spread or not body.is_pair(*positional[:2]):
            return False
        references = self.program.resolve(body.function, node.func)
        # self.l1_loss(...) in a method of its name: there it is the term itself
        known = [r for r in references if r.kind != "made by" or body.function.name in CALLED]
        return any(self.shape_of_reference(reference, body.depth + 1) for reference in known)


def _selected(function: Function, nodes: Sequence[ast.AST]) -> Tuple[List[Tuple[str, str]], Set[int]]:
    """Return the two parameters and equal selections of both, ``x = a[:, mask]``, ``y = b[:, mask]``.

    Returns:
        Those pairs of names, and the ids of the assignments' parts; ``a = a[mask]``, ``b = b[mask]`` are such, too.
    """
    a, b = function.parameters[:2]
    pairs, selecting = [(a, b)], set()
    assigned = [(node, node.targets[0]) for node in nodes if isinstance(node, ast.Assign)]
    for (first, one), (second, other) in zip(assigned, assigned[1:]):
        if not (isinstance(one, ast.Name) and isinstance(other, ast.Name)):
            continue
        is_new = all(len(function.flow.definitions.get(name.id, ())) == 1 for name in (one, other))
        is_new = is_new and isinstance(first.value, ast.Subscript)
        if (is_new or {one.id, other.id} == {a, b}) and _are_mirrored(first.value, second.value, a, b):
            pairs.append((one.id, other.id))
            selecting |= {id(part) for node in (first, second) for part in walk_expressions(node)}
    return pairs, selecting


def _are_mirrored(left: ast.AST, right: ast.AST, a: str, b: str) -> bool:
    """Return whether two expressions are equal except for ``a`` in one and ``b`` in the other; not ``self.net(a)``."""
    either = re.compile(rf"\b({re.escape(a)}|{re.escape(b)})\b")
    texts = [re.sub(r"\s+", "", code(node)).strip("()") for node in (left, right)]
    one, other = (set(either.findall(text)) for text in texts)
    if re.search(r"\bself\.\w+\(", texts[0]):
        return False
    return len(one) == len(other) == 1 and one != other and either.sub("?", texts[0]) == either.sub("?", texts[1])
