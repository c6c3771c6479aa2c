"""What an L1 term looks like in code: ``torch.abs(a - b).mean()``, ``F.l1_loss(a, b)``, the codebase's own function."""

from __future__ import annotations

import re
from typing import Dict, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.module import Function
from legs_adapters.reading.program import Program, Reference
from legs_adapters.reading.syntax import arguments, call_name, code, constant, key_of, walk_expressions

__all__ = ["Form", "Forms", "abs_argument", "forms", "is_l1_name", "own_shape"]

_TORCH_L1 = re.compile(r"(^|\.)(torch\.nn\.functional|nn\.functional|functional)\.l1_loss$")
_GSPLAT_L1 = re.compile(r"^gsplat\.losses\.l1_loss$")
_TORCH_MODULE = re.compile(r"(^|\.)L1Loss$")  # nerfstudio hands torch's on
_L1_NAME = re.compile(
    r"^(masked|mask|weighted|pixel|pixelwise|rgb|color|image|photometric)*l1(loss)?(loss|mask(ed)?|rgb|withmask|v\d+)*$"
)
_SPEAKS_OF_LOSS = re.compile(r"l1|mae|loss|photo|color|rgb|abs", re.I)
_SHAPE_ONLY = {"shape", "device", "dtype", "dim", "ndim", "size", "numel", "is_cuda"}
_TRANSFORMS = {"pow", "square", "log", "log1p", "log2", "log10", "exp", "sqrt", "tanh", "sigmoid"}
_ASKING = {"isnan", "isfinite", "isinf", "zeros_like", "ones_like"}
_AS_THAT = {"to", "type_as", "expand_as", "view_as", "reshape_as"}  # mask.to(prediction)
# Decorators that return what the function returns.
_TRANSPARENT = {"staticmethod", "classmethod", "script", "compile", "jaxtyped", "typechecked", "autocast"}
_NOT_L1 = {"pow", "square", "sqrt", "log", "exp", "mse_loss", "norm", "smooth_l1_loss", "huber_loss"}


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


def is_l1_name(name: str) -> bool:
    """Return whether a function of this name is an L1, going by the name."""
    return _L1_NAME.match(name.replace("_", "").lower()) is not None


def forms(program: Program, function: Function) -> List[Form]:
    """Return the L1 expressions in a function's own body, in source order; the widest where they nest."""
    found: List[Form] = []
    inside = _transformed(function)
    for node in function.flow.expressions:
        if id(node) in inside or not isinstance(node, cst.Call):
            continue
        form = _absolute(program, function, node) or _call(program, function, node)
        form = form or _of_difference(program, function, node)
        if form is not None:
            found.append(form)
            inside.add(id(form.call))
            if form.difference is None or form.callee is None:
                inside.update(id(n) for n in walk_expressions(form.node) if isinstance(n, cst.Call) and _is_abs(n))
    return found


class Forms:
    """The forms of each function of one program, looked for once."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._known: Dict[Function, List[Form]] = {}

    def of(self, function: Function) -> List[Form]:
        """Return the L1 expressions in a function's own body."""
        if function not in self._known:
            self._known[function] = forms(self._program, function)
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


# -- absolute values


def _absolute(program: Program, function: Function, node: cst.Call) -> Optional[Form]:
    reduction, inner = "none", node
    meant = _mean_of(node)
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


def _mean_of(node: cst.Call) -> Optional[cst.Call]:
    """Return ``x`` of ``x.mean()`` or ``torch.mean(x)``: the mean of everything, nothing else asked for."""
    if call_name(node) != "mean" or not isinstance(node.func, cst.Attribute):
        return None
    if not node.args and isinstance(node.func.value, cst.Call):
        return node.func.value
    if _is_module(node.func.value) and len(node.args) == 1 and isinstance(node.args[0].value, cst.Call):
        return node.args[0].value
    return None


def abs_argument(node: cst.CSTNode) -> Optional[cst.BaseExpression]:
    """Return what an absolute value is taken of; None of what takes none."""
    if not isinstance(node, cst.Call) or not _is_abs(node):
        return None
    if isinstance(node.func, cst.Attribute) and not node.args:
        return node.func.value
    return node.args[0].value if len(node.args) == 1 and not node.args[0].star else None


def _is_abs(node: cst.Call) -> bool:
    if isinstance(node.func, cst.Name):
        return node.func.value == "abs"
    if isinstance(node.func, cst.Attribute) and node.func.attr.value in ("abs", "absolute"):
        return not node.args or (len(node.args) == 1 and _is_module(node.func.value))
    return False


def _is_module(node: cst.CSTNode) -> bool:
    """Whether what has ``abs`` or ``mean`` can be torch, under whatever name: a tensor's own take no tensor."""
    return isinstance(node, cst.Name) and node.value not in ("np", "numpy", "math", "jnp", "cp", "cupy", "tf")


# -- calls of functions


def _call(program: Program, function: Function, node: cst.Call) -> Optional[Form]:
    if len(node.args) < 2:
        return None
    references = program.resolve(function, node.func)
    if any(reference.kind == "external" and str(reference.target).startswith("legs_loss.") for reference in references):
        return None  # patched before
    name = call_name(node)
    references = references or _handed_on(program, function, node)
    if not references:
        if not is_l1_name(name):
            return None
        pair = _pair(node, None)
        return None if pair is None else Form(node, node, pair[0], pair[1], "own", node.func, pair[2])
    shapes = [_reference_shape(program, reference, node) for reference in references]
    if None in shapes:
        return None
    names = next((r.target.parameters for r in references if isinstance(r.target, Function)), None)
    pair = _pair(node, names)
    if pair is None:
        return None
    first, second, extras = pair
    reduction = shapes[0] if len(set(shapes)) == 1 else "own"
    assert reduction is not None
    if all(r.kind == "external" and _TORCH_L1.search(str(r.target)) for r in references):
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
            if not references or not all(r.kind == "external" and _TORCH_L1.search(str(r.target)) for r in references):
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


def _reference_shape(program: Program, reference: Reference, node: cst.Call) -> Optional[str]:
    if reference.kind == "external":
        name = str(reference.target)
        if _GSPLAT_L1.match(name):
            return "none"
        if _TORCH_L1.search(name):
            return "own"
        return "own" if is_l1_name(name.split(".")[-1]) and not name.endswith("L1Loss") else None
    if reference.kind == "made by":
        return "own" if _TORCH_MODULE.search(str(reference.target)) else None
    if reference.kind == "function" and isinstance(reference.target, Function):
        return own_shape(program, reference.target, node)
    if reference.kind == "instance":
        methods = program.member(reference.target, "forward")  # type: ignore[arg-type]
        if len(methods) == 1 and isinstance(methods[0].target, Function):
            return "own" if own_shape(program, methods[0].target, node) else None
    return None


# -- the codebase's own functions


def own_shape(program: Program, function: Function, call: Optional[cst.Call] = None, depth: int = 0) -> Optional[str]:
    """Say what a function of the checkout makes of its first two arguments.

    Args:
        call: how it is called: arguments that it does not get have their defaults.

    Returns:
        "mean" for ``abs(a - b).mean()``, "none" for ``abs(a - b)``, "own" for what else is an L1 and depends on
        nothing but the difference (and on further arguments); None for what is not.
    """
    names = function.parameters
    if len(names) < 2 or depth > 4 or not program.prospects.of(function.text):
        return None
    a, b = names[:2]
    if not _only_differences(program, function, a, b, depth):
        return None
    if set(function.decorators) - _TRANSPARENT:
        return "own"  # what is returned is the decorator's to say: a mean, a weight
    known = _known_arguments(function, call)
    returned = _follow(function.body.body, {}, known)
    if returned is not None:
        shape = _shape_of(program, function, returned, a, b, depth)
        if shape is not None:
            return shape
    return "own" if _SPEAKS_OF_LOSS.search(function.name) or function.name in ("forward", "__call__") else None


def _shape_of(program: Program, function: Function, node: cst.CSTNode, a: str, b: str, depth: int) -> Optional[str]:
    if not isinstance(node, cst.Call):
        return None
    meant = _mean_of(node)
    argument = abs_argument(meant if meant is not None else node)
    if isinstance(argument, cst.BinaryOperation) and isinstance(argument.operator, cst.Subtract):
        if {code(argument.left).strip("() "), code(argument.right).strip("() ")} == {a, b}:
            return "mean" if meant is not None else "none"
        return None
    positional, keywords, starred = arguments(node)
    if [code(value) for value in positional[:2]] != [a, b] or starred:
        return None
    references = program.resolve(function, node.func)
    if len(references) != 1:
        return None
    reference = references[0]
    if reference.kind == "external" and _TORCH_L1.search(str(reference.target)) and len(positional) == 2:
        return "none" if list(keywords) == ["reduction"] and constant(keywords["reduction"]) == "none" else None
    if reference.kind == "function" and isinstance(reference.target, Function) and len(node.args) == 2:
        shape = own_shape(program, reference.target, node, depth + 1)
        return shape if shape in ("mean", "none") else None
    return None


def _known_arguments(function: Function, call: Optional[cst.Call]) -> Dict[str, object]:
    """Return the parameters whose values the call settles: literals, and defaults of what it leaves out."""
    assert isinstance(function.node, cst.FunctionDef)
    if call is None:
        return {}
    positional, keywords, starred = arguments(call)
    known: Dict[str, object] = {}
    missing = object()
    if starred:
        return known
    params = [p for p in (*function.node.params.posonly_params, *function.node.params.params)]
    params = [p for p in params if p.name.value in function.parameters]
    for i, param in enumerate([*params, *function.node.params.kwonly_params]):
        name = param.name.value
        if i < len(positional) and param in params:
            value = constant(positional[i], missing)
        elif name in keywords:
            value = constant(keywords[name], missing)
        else:
            value = constant(param.default, missing) if param.default is not None else missing
        if value is not missing:
            known[name] = value
    return known


def _follow(
    statements: object, names: Dict[str, cst.BaseExpression], known: Dict[str, object]
) -> Optional[cst.CSTNode]:
    """Return what straight-line code returns, its local names filled in; None where that is not one expression."""
    flat: List[cst.CSTNode] = []
    for statement in statements:  # type: ignore[attr-defined]
        flat.extend(statement.body if isinstance(statement, cst.SimpleStatementLine) else [statement])
    for statement in flat:
        if isinstance(statement, cst.Return):
            if statement.value is None:
                return None
            return _decide(_fill(statement.value, names), known)
        if isinstance(statement, cst.Assign) and len(statement.targets) == 1:
            target = statement.targets[0].target
            if not isinstance(target, cst.Name):
                return None
            names[target.value] = _fill(statement.value, names)
        elif isinstance(statement, cst.If):
            truth = _truth(statement.test, known)
            if truth is None:
                return None
            if truth:
                returned = _follow(statement.body.body, names, known)
                if returned is not None or _leaves(statement.body.body):
                    return returned
            elif isinstance(statement.orelse, cst.Else):
                returned = _follow(statement.orelse.body.body, names, known)
                if returned is not None or _leaves(statement.orelse.body.body):
                    return returned
            elif statement.orelse is not None:
                return None
        elif (
            isinstance(statement, cst.Expr) and isinstance(statement.value, (cst.SimpleString, cst.ConcatenatedString))
        ) or isinstance(statement, (cst.Assert, cst.Pass)):
            continue
        else:
            return None
    return None


def _leaves(statements: object) -> bool:
    last = list(statements)[-1]  # type: ignore[call-overload]
    return isinstance(last, cst.SimpleStatementLine) and isinstance(last.body[-1], (cst.Return, cst.Raise))


def _fill(node: cst.BaseExpression, names: Dict[str, cst.BaseExpression]) -> cst.BaseExpression:
    if not names:
        return node

    class Fill(cst.CSTTransformer):
        def leave_Name(self, original_node: cst.Name, updated_node: cst.Name) -> cst.BaseExpression:
            return names.get(original_node.value, updated_node)

        def visit_Attribute_attr(self, node: cst.Attribute) -> None:
            pass

        def leave_Attribute(self, original_node: cst.Attribute, updated_node: cst.Attribute) -> cst.BaseExpression:
            return updated_node.with_changes(attr=original_node.attr)

        def leave_Arg(self, original_node: cst.Arg, updated_node: cst.Arg) -> cst.Arg:
            return updated_node.with_changes(keyword=original_node.keyword)

    filled = node.visit(Fill())
    assert isinstance(filled, cst.BaseExpression)
    return filled


def _decide(node: cst.BaseExpression, known: Dict[str, object]) -> cst.BaseExpression:
    if isinstance(node, cst.IfExp):
        truth = _truth(node.test, known)
        if truth is not None:
            return _decide(node.body if truth else node.orelse, known)
    return node


def _truth(node: cst.BaseExpression, known: Dict[str, object]) -> Optional[bool]:
    if isinstance(node, cst.Name) and node.value in known:
        return bool(known[node.value])
    if isinstance(node, cst.UnaryOperation) and isinstance(node.operator, cst.Not):
        inner = _truth(node.expression, known)
        return None if inner is None else not inner
    if isinstance(node, cst.Comparison) and len(node.comparisons) == 1 and isinstance(node.left, cst.Name):
        comparison = node.comparisons[0]
        missing = object()
        right = constant(comparison.comparator, missing)
        if node.left.value in known and right is not missing:
            left = known[node.left.value]
            if isinstance(comparison.operator, (cst.Is, cst.Equal)):
                return left == right
            if isinstance(comparison.operator, (cst.IsNot, cst.NotEqual)):
                return left != right
    return None


def _only_differences(program: Program, function: Function, a: str, b: str, depth: int) -> bool:
    """Return whether a function is an L1 of its first two parameters: they meet in differences, and in no other way."""
    if function not in program.only_differences:
        program.only_differences[function] = False  # what asks for itself on the way
        program.only_differences[function] = _meet_in_differences(program, function, a, b, depth)
    return program.only_differences[function]


def _meet_in_differences(program: Program, function: Function, a: str, b: str, depth: int) -> bool:
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
            if isinstance(node.operator, (cst.Power,)):
                return False
            if isinstance(node.operator, cst.Multiply) and constant(node.right, 1) == 0:
                allowed.update(id(n) for n in walk_expressions(node))
            if isinstance(node.operator, cst.Subtract) and mirrored(node.left, node.right):
                if _is_made_by(program, function, node.left):
                    return False  # edges(a) - edges(b): of what is made of the two
                allowed.update(id(n) for n in walk_expressions(node))
        elif isinstance(node, cst.Call):
            name = call_name(node)
            if name in _NOT_L1:
                return False
            if name in _ASKING or name in _AS_THAT:
                allowed.update(id(n) for arg in node.args for n in walk_expressions(arg))
            absolute = absolute or _is_abs(node)
            positional = arguments(node)[0]
            spread = any(arg.star == "*" for arg in node.args)
            pair = len(positional) >= 2 and not spread and mirrored(positional[0], positional[1])
            if pair and (
                any(_l1_reference(program, function, r, node, depth) for r in program.resolve(function, node.func))
                or any(_is_handed_l1(program, function, value, depth) for value in positional[2:])
            ):
                allowed.update(id(n) for value in positional[:2] for n in walk_expressions(value))
                absolute = True
        elif isinstance(node, cst.Comparison):
            # A mask made from the second, `gt != 0`: it is handed over as it is.
            allowed.update(id(n) for n in walk_expressions(node) if isinstance(n, cst.Name) and n.value == b)
        elif isinstance(node, cst.Attribute) and node.attr.value in _SHAPE_ONLY:
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
    beside = [each.value for value in function.flow.returns if isinstance(value, cst.Tuple) for each in value.elements]
    if not all(function.depends(each, {a, b}) for each in beside):
        return False  # return loss, mask
    for (one, target, value), (other, other_target, other_value) in zip(changed[::2], changed[1::2]):
        if {one, other} != {a, b} or not _mirrored(value, other_value, a, b):
            return False
        for part in (target, value, other_target, other_value):
            allowed.update(id(n) for n in walk_expressions(part))
    compared = {name for pair in pairs for name in pair}
    names = [node for node in nodes if isinstance(node, cst.Name) and node.value in compared]
    return bool(names) and all(id(node) in allowed for node in names)


def _is_made_by(program: Program, function: Function, node: cst.CSTNode) -> bool:
    """Whether an expression calls a function of the codebase."""
    calls = [part for part in walk_expressions(node) if isinstance(part, cst.Call)]
    return any(r.kind == "function" and not r.guess for call in calls for r in program.resolve(function, call.func))


def _picked_pairs(
    function: Function, nodes: List[cst.CSTNode], a: str, b: str
) -> Tuple[List[Tuple[str, str]], Set[int]]:
    """The two parameters and what is picked alike out of them, ``x = a[:, mask]``, ``y = b[:, mask]``.

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


def _l1_reference(program: Program, function: Function, reference: Reference, node: cst.Call, depth: int) -> bool:
    if reference.kind == "made by" and function.name not in ("forward", "__call__"):
        return False  # self.l1_loss(...) in a method of its name: there it is the term itself
    if reference.kind == "function" and isinstance(reference.target, Function):
        return own_shape(program, reference.target, node, depth + 1) is not None
    return reference.kind in ("external", "made by") and _reference_shape(program, reference, node) is not None


def _is_handed_l1(program: Program, function: Function, node: cst.BaseExpression, depth: int) -> bool:
    """Whether an argument is an L1 function itself, as in ``masked_loss(pred, gt, l1, mask=mask)``."""
    return isinstance(node, cst.Name) and is_l1_function(program, function, node, depth)


def is_l1_function(program: Program, function: Function, node: cst.CSTNode, depth: int = 0) -> bool:
    """Return whether an expression is an L1 function, torch's or the codebase's own."""

    def is_l1(reference: Reference) -> bool:
        if isinstance(reference.target, Function):
            return not reference.guess and own_shape(program, reference.target, None, depth + 1) is not None
        return reference.kind == "external" and _TORCH_L1.search(str(reference.target)) is not None

    references = program.resolve(function, node)
    return bool(references) and all(map(is_l1, references))


def _mirrored(left: cst.BaseExpression, right: cst.BaseExpression, a: str, b: str) -> bool:
    """Return whether two expressions are the same but for ``a`` in the one and ``b`` in the other."""
    swap = re.compile(rf"\b({re.escape(a)}|{re.escape(b)})\b")
    texts = [re.sub(r"\s+", "", code(node)).strip("()") for node in (left, right)]
    found = [swap.findall(text) for text in texts]
    if not found[0] or not found[1] or len(set(found[0])) != 1 or len(set(found[1])) != 1 or found[0][0] == found[1][0]:
        return False
    return swap.sub("?", texts[0]) == swap.sub("?", texts[1])
