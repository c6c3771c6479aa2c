"""What an L1 term looks like in code: ``torch.abs(a - b).mean()``, ``F.l1_loss(a, b)``, the codebase's own function."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.syntax import arguments, call_name, code, constant, walk_expressions
from legs_adapters.tensors.absolute import abs_argument, is_abs, mean_of
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.l1_names import TORCH_L1, is_l1_name

__all__ = ["Form", "Forms"]

_TRANSFORMS = {"pow", "square", "log", "log1p", "log2", "log10", "exp", "sqrt", "tanh", "sigmoid"}


class Form(NamedTuple):
    """An L1 between two expressions.

    Attributes:
        node: all of the expression that is the L1 term.
        call: the call in it that has the two arguments, or that takes the absolute value.
        first, second: the two arguments, as written.
        reduction: "mean", "none" (an unreduced map), "own": what the codebase's function makes of it, "wrapped":
            an expression around the difference, "again": a map with another use, of which ``node`` is the read that
            is the loss, "signed": of a difference that a function made and weighted, "taken": of one that a function
            takes the absolute value of, or "callable" and "registered" for a function handed over by name.
        callee: what is called, for a form that is a call of a function; None for ``abs``.
        extras: the call's further arguments.
        difference: the ``a - b``, for a form that is an absolute value.
        direct: False where the difference has a name of its own, so that there is no one expression to replace.
        selection: for such a difference, the index that it is taken with, ``[mask]``; empty without.
    """

    node: cst.BaseExpression
    call: cst.Call
    first: cst.BaseExpression
    second: cst.BaseExpression
    reduction: str
    callee: Optional[cst.BaseExpression] = None
    extras: Tuple[cst.Arg, ...] = ()
    difference: Optional[cst.BinaryOperation] = None
    direct: bool = True
    selection: str = ""


def _forms(functions: L1Functions, function: Function) -> List[Form]:
    """Return the L1 expressions in a function's own body, in source order; the widest where they nest."""
    found: List[Form] = []
    inside = _transformed(function)
    for node in function.flow.expressions:
        if id(node) in inside or not isinstance(node, cst.Call):
            continue
        form = _absolute(functions.program, function, node) or _call(functions, function, node)
        form = form or _of_difference(functions.program, function, node)
        if form is not None:
            found.append(form)
            inside.add(id(form.call))
            if form.difference is None or form.callee is None:
                inside.update(id(n) for n in walk_expressions(form.node) if isinstance(n, cst.Call) and is_abs(n))
    return found


class Forms:
    """The forms of each function of one program, looked for once."""

    def __init__(self, functions: L1Functions) -> None:
        self.functions = functions
        self._known: Dict[Function, List[Form]] = {}

    def of(self, function: Function) -> List[Form]:
        """Return the L1 expressions in a function's own body."""
        if function not in self._known:
            self._known[function] = _forms(self.functions, function)
        return self._known[function]


def _transformed(function: Function) -> Set[int]:
    """The ids of the calls whose values are squared, or go through a logarithm and its like: no L1 any more."""
    found: Set[int] = set()
    for node in function.flow.expressions:
        parts: List[cst.CSTNode] = []
        if isinstance(node, cst.BinaryOperation) and isinstance(node.operator, cst.Power):
            parts = [node.left]
        elif isinstance(node, cst.Call) and call_name(node) in _TRANSFORMS:
            parts = [node.func, *node.args]
        for part in parts:
            found.update(id(n) for n in walk_expressions(part) if isinstance(n, cst.Call) and n is not node)
    return found


def _absolute(program: Program, function: Function, node: cst.Call) -> Optional[Form]:
    reduction, inner = "none", node
    meant = mean_of(node)
    if meant is not None:
        reduction, inner = "mean", meant
    argument = abs_argument(inner)
    if argument is None:
        return None
    if isinstance(argument, cst.BinaryOperation) and isinstance(argument.operator, cst.Subtract):
        if _is_number(argument.left) or _is_number(argument.right):
            return None
        return Form(node, inner, argument.left, argument.right, reduction, difference=argument)
    if isinstance(argument, cst.BinaryOperation) and isinstance(argument.operator, (cst.Multiply, cst.Divide)):
        for side in (argument.left, argument.right)[: 1 if isinstance(argument.operator, cst.Divide) else 2]:
            if isinstance(side, cst.BinaryOperation) and isinstance(side.operator, cst.Subtract):
                return Form(inner, inner, side.left, side.right, "wrapped", difference=side)
    selection = ""
    if isinstance(argument, cst.Subscript):
        selection = code(argument)[len(code(argument.value)) :].strip()
        argument = argument.value
    if isinstance(argument, cst.Name):
        definitions = list(function.flow.reaching(argument))
        if len(definitions) == 1 and definitions[0].kind == "assign":
            value = definitions[0].value
            if isinstance(value, cst.BinaryOperation) and isinstance(value.operator, cst.Subtract):
                return Form(node, inner, value.left, value.right, reduction, None, (), value, False, selection)
            if isinstance(value, cst.Call) and not selection and _returns_difference(program, function, value):
                first, second = arguments(value)[0][:2]
                return Form(node, inner, first, second, "signed")
    return None


def _returns_difference(program: Program, function: Function, call: cst.Call) -> bool:
    """``difference = relative(image, gt)``, where that is ``weight * (a - b)`` of its first two parameters."""
    made = program.resolve(function, call.func)
    if len(made) != 1 or made[0].guess or not isinstance(made[0].target, Function) or len(arguments(call)[0]) < 2:
        return False
    maker = made[0].target
    if len(maker.flow.returns) != 1 or len(maker.parameters) < 2:
        return False
    value: Optional[cst.CSTNode] = maker.flow.returns[0]
    if isinstance(value, cst.Name):
        found = list(maker.flow.reaching(value))
        value = found[0].value if len(found) == 1 and found[0].kind == "assign" else None
    if not isinstance(value, cst.BinaryOperation) or not isinstance(value.operator, (cst.Multiply, cst.Divide)):
        return False
    sides = [side for side in (value.left, value.right) if isinstance(side, cst.BinaryOperation)]
    compared = [{code(side.left), code(side.right)} for side in sides if isinstance(side.operator, cst.Subtract)]
    return set(maker.parameters[:2]) in compared


def _is_number(node: cst.CSTNode) -> bool:
    return isinstance(node, cst.Call) and isinstance(node.func, cst.Name) and node.func.value in ("int", "float", "len")


def _call(functions: L1Functions, function: Function, node: cst.Call) -> Optional[Form]:
    if len(node.args) < 2:
        return None
    references = functions.program.resolve(function, node.func)
    if any(reference.kind == "external" and str(reference.target).startswith("legs_loss.") for reference in references):
        return None  # patched before
    name = call_name(node)
    references = references or _handed_on(functions.program, function, node)
    if not references:
        if not is_l1_name(name):
            return None
        pair = _pair(node, None)
        return None if pair is None else Form(node, node, pair[0], pair[1], "own", node.func, pair[2])
    shapes = [functions.shape_of_reference(reference, node) for reference in references]
    if None in shapes:
        return None
    names = next((r.target.parameters for r in references if isinstance(r.target, Function)), None)
    pair = _pair(node, names)
    if pair is None:
        return None
    first, second, extras = pair
    reduction = shapes[0] if len(set(shapes)) == 1 else "own"
    assert reduction is not None
    if all(r.kind == "external" and TORCH_L1.search(str(r.target)) for r in references):
        keywords = {arg.keyword.value: constant(arg.value) for arg in extras if arg.keyword is not None}
        if keywords == {"reduction": "none"} and len(extras) == 1:
            reduction, extras = "none", ()
        elif keywords == {"reduction": "mean"} and len(extras) == 1:
            extras = ()
    elif reduction in ("mean", "none") and extras:
        # The arguments that settled the shape; the call no longer needs them.
        extras = ()
    return Form(node, node, first, second, reduction, node.func, tuple(extras))


def _of_difference(program: Program, function: Function, node: cst.Call) -> Optional[Form]:
    """``robust(residual, config)`` of ``residual = image - gt``, where it makes its loss of ``residual.abs()``."""
    given = arguments(node)[0][:1]
    made = list(function.flow.reaching(given[0])) if given and isinstance(given[0], cst.Name) else []
    value = made[0].value if len(made) == 1 and made[0].kind == "assign" else None
    if not isinstance(value, cst.BinaryOperation) or not isinstance(value.operator, cst.Subtract):
        return None
    takers = [r.target for r in program.resolve(function, node.func) if r.kind == "function" and not r.guess]
    known = [taker for taker in takers if isinstance(taker, Function) and _takes_absolute(taker)]
    if len(takers) != 1 or not known:
        return None
    return Form(node, node, value.left, value.right, "taken", node.func, tuple(node.args[1:]), value, False)


def _takes_absolute(function: Function) -> bool:
    """Whether a function takes the absolute value of its first parameter, as it is."""
    taken = [abs_argument(call) for call in function.flow.calls if function.parameters]
    return any(_is_parameter(function, part) and code(part) == function.parameters[0] for part in taken if part)


def _handed_on(program: Program, function: Function, node: cst.Call) -> List[Reference]:
    """``def on_crops(image, gt, loss_fn)``: a parameter is torch's L1 where that is what every caller gives."""
    name = call_name(node)
    if not _is_parameter(function, node.func) or arguments(node)[2]:
        return []
    if not function.name or function.name in ("forward", "__call__"):
        return []
    found: List[Reference] = []
    for caller in program.mentioning(function.name, called=True):
        for call in caller.flow.calls:
            if call_name(call) != function.name:
                continue
            value = function.given(call, name)
            references = program.resolve(caller, value) if value is not None else []
            if not references or not all(r.kind == "external" and TORCH_L1.search(str(r.target)) for r in references):
                return []
            found += references
    return found


def _is_parameter(function: Function, node: cst.CSTNode) -> bool:
    """Whether a name is a parameter of the function and nothing else."""
    known = isinstance(node, cst.Name) and node.value in function.parameters
    return known and all(definition.kind == "parameter" for definition in function.flow.reaching(node))


def _pair(
    node: cst.Call, names: Optional[List[str]]
) -> Optional[Tuple[cst.BaseExpression, cst.BaseExpression, Tuple[cst.Arg, ...]]]:
    """Return the two arguments that are compared, and the others."""
    positional, keywords, starred = arguments(node)
    if starred:
        return None
    if len(positional) >= 2:
        taken: List[cst.BaseExpression] = positional[:2]
    else:
        known = [names[:2]] if names else []
        known += [
            ["input", "target"],
            ["prediction", "target"],
            ["network_output", "gt"],
            ["pred", "gt"],
            ["pred", "target"],
        ]
        taken = []
        for pair in known:
            if len(pair) == 2:
                values = [*positional, *(keywords[key] for key in pair[len(positional) :] if key in keywords)]
                if len(values) == 2:
                    taken = values
                    break
        if not taken:
            return None
    extras = tuple(arg for arg in node.args if not any(arg.value is value for value in taken))
    return taken[0], taken[1], extras
