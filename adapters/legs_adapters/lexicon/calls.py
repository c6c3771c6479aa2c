"""Find what a call depicts: a rendering, a loaded photograph, or a function of an image.

The readings are asked in their order; the first that knows a call decides. What stands earlier is more certain: what
torch's operations do, then what a name says, then what the arguments are, then what the called function returns.
"""

from __future__ import annotations

import ast
from typing import Callable, Dict, List, Optional

from legs_adapters.code.calls import callees
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.returned import returned
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    call_name,
    constant,
    dotted,
    given,
    indices,
    name_of,
    same,
    walk_expressions,
    words,
)
from legs_adapters.lexicon.meaning import UNKNOWN, Meaning, mix
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.words import RENDERERS, STATISTICS
from legs_adapters.tensors.operations import (
    ASKS,
    EXTREMES,
    JOINS,
    KEEPS_PICTURES,
    LEARNED,
    LOGARITHMS,
    MODULES,
    NUMBERS,
    PICTURE_FUNCTIONS,
    PICTURE_METHODS,
    REDUCES,
)

MeaningOf = Callable[[Function, ast.AST], Meaning]  # of an expression of a function


class CallReading:
    """A call in a function, and whom to ask about the expressions in it.

    Args:
        program, function, node: the call, the function that it stands in, and the program.
        meaning_of: what an expression of a function depicts.

    Attributes:
        name: the last name of the callee.
        positional, keywords, values: its arguments: the positional ones, the others by name, all of them.
        owner: the object whose method is called; None for a function, of a module too.
    """

    def __init__(self, program: Program, function: Function, node: ast.Call, meaning_of: MeaningOf) -> None:
        self.program = program
        self.function = function
        self.node = node
        self.meaning_of = meaning_of
        self.name: str = call_name(node)
        self.positional: List[ast.expr] = arguments(node)[0]
        self.keywords: Dict[str, ast.expr] = arguments(node)[1]
        self.values: List[ast.expr] = [*self.positional, *self.keywords.values()]
        base = node.func.value if isinstance(node.func, ast.Attribute) else None
        self.owner: Optional[ast.expr] = None if self._is_module(base) else base

    def ask(self, node: ast.AST) -> Meaning:
        """Return the meaning of an expression of the function."""
        return self.meaning_of(self.function, node)

    def _is_module(self, node: Optional[ast.AST]) -> bool:
        """Return whether a name is a module's, ``th`` of ``import torch as th``."""
        if not isinstance(node, ast.Name):
            return False
        found = self.program.lookup(self.function, node)
        return node.id in MODULES or (found is not None and all(isinstance(d.value, ast.Import) for d in found[1]))


def meaning_of_call(call: CallReading, by_arguments: bool = True) -> Meaning:
    """Return what a call depicts, from its name and what the function returns; on request from its arguments, too."""
    readings = (*_SURE, *((_of_images, meaning_returned, _of_owner) if by_arguments else (meaning_returned,)))
    return next((known for known in (reading(call) for reading in readings) if known is not None), UNKNOWN)


def _number(call: CallReading) -> Optional[Meaning]:
    """A number, or what has only the shape of its argument."""
    is_number = call.name in NUMBERS if isinstance(call.node.func, ast.Name) else call.name == "item"
    return UNKNOWN if is_number or call.name in ASKS else None


def _reduced(call: CallReading) -> Optional[Meaning]:
    """A number of the whole image, or one a channel; the grey picture; the brightest pixel or channel: a prior."""
    of = call.owner or next(iter(call.positional), None)
    positional = call.positional if call.owner is not None else call.positional[1:]
    axes = [*positional, *(value for name, value in call.keywords.items() if name in ("dim", "axis"))]
    if call.name in REDUCES | EXTREMES and all(isinstance(constant(axis), tuple) for axis in axes):
        return Meaning("parameter", None)
    made = of and (call.function.flow.value_of(of) or of)
    is_joined = isinstance(made, ast.Call) and call_name(made) in JOINS  # the mean of several pictures
    is_grey = call.name in REDUCES and constant(call.keywords.get("keepdim")) and not is_joined
    if of is None or not (is_grey or call.name in EXTREMES):
        return None
    meaning = call.ask(of)
    by_axis = "dim" in call.keywords or any(isinstance(constant(axis), int) for axis in axes)
    is_other = meaning.kind == "image" and by_axis
    return meaning._replace(kind="feature" if is_grey else "parameter") if is_other else meaning


def _filtered(call: CallReading) -> Optional[Meaning]:
    """A statistic of a picture, or what a filter finds in it."""
    filters = call.name in ("conv2d", "filter2d", "spatial_gradient") and "stride" not in call.keywords
    kind = "feature" if STATISTICS & set(words(call.name)) else "gradient" if filters else None
    return Meaning(kind, call.ask(call.values[0]).role) if kind and call.values else None


def _moved(call: CallReading) -> Optional[Meaning]:
    """An operation of torch that returns its argument in another shape, type or size."""
    if picked_from(call.node) == 3:
        return Meaning("channel", None)
    if call.name in JOINS and call.values:
        return call.ask(call.values[0])
    if call.owner is not None and call.name in (*PICTURE_METHODS, "pop", "popleft", "__getitem__"):
        return call.ask(call.owner)
    is_function = call.owner is None and call.name in PICTURE_FUNCTIONS
    return call.ask(call.values[0]) if is_function and call.values else None


def _on_another_scale(call: CallReading) -> Optional[Meaning]:
    """The logarithm of a picture, or what has it as its logarithm."""
    of = call.owner or next(iter(call.positional), None)
    if call.name not in LOGARITHMS or of is None:
        return None
    meaning = call.ask(of)
    return meaning._replace(kind="logarithm") if meaning.kind == "image" else meaning


def picked_from(call: ast.Call, index: int = 0) -> int:
    """Return the channel at which a part of a picture begins, ``x.narrow(0, 3, 1)``, ``x.split([3, 1])[1]``; or 0."""
    values = [constant(arg.value) for arg in given(call)]
    if call_name(call) == "narrow":
        return values[-2] if isinstance(values[-2], int) else 0
    sizes = next((each for each in values if isinstance(each, (list, tuple))), ())
    return sum(each for each in sizes[:index] if isinstance(each, int)) if call_name(call) == "split" else 0


def _keyed(call: CallReading) -> Optional[Meaning]:
    """The picture under the key that a call gives, ``drawn(camera, "depth")``, whatever other calls ask for."""
    for callee in callees(call.program, call.function, call.node) if call.values else ():
        sides = [(name, callee.given(call.node, name)) for name in callee.parameters]
        said = {name: constant(call.function.flow.value_of(side) or side) for name, side in sides if side is not None}
        keys = {name: key for name, key in said.items() if isinstance(key, str)}
        parts = callee.walk() if keys and callee.module.spend(callee.flow.steps) else ()
        names = [name_of(index) for part in parts if isinstance(part, ast.Subscript) for index in indices(part)]
        key = next((keys[name] for name in names if name in keys), "")
        if key:
            returned = mix(call.meaning_of(callee, value) for value in callee.flow.returns)
            if kind_of_words(key) is not None or returned.kind not in (None, "image"):  # the kind of another key
                return Meaning(kind_of_words(key), role_of_words(key) or returned.role)
    return None


def _rendered(call: CallReading) -> Optional[Meaning]:
    kind = kind_of_words(call.name)
    if not set(words(call.name)) & RENDERERS:
        return None
    return Meaning("image" if kind in (None, "parameter") else kind, "render")  # points_to_render(...)


def _named(call: CallReading) -> Optional[Meaning]:
    kind, role = kind_of_words(call.name), role_of_words(call.name)
    if call.name.lower().strip("_") == "sh2rgb":
        return Meaning("parameter", None)  # the colours of Gaussians
    if kind not in (None, "image", "mask", "parameter"):
        return Meaning(kind, role)
    return Meaning(kind, role) if kind == "image" and role == "target" else None


def _of_images(call: CallReading) -> Optional[Meaning]:
    """A function of an image is an image, unless its name or body says otherwise: exposure, appearance, a background.

    What an object of a library makes of one, ``dwt(image)``, an unknown member, ``self.net(image)``, or an operation of
    torch that is in no list, ``torch.diff(image)``, is not known. Of a depth alone it is no image: ``colormap(depth)``.
    """
    references = call.program.resolve(call.function, call.node.func)
    is_member = call.owner is not None and dotted(call.owner) == "self"
    asked = [call.ask(value) for value in call.values if constant(value) is None]
    if any(LEARNED.match(str(each.target)) for each in references) and mix(asked).role in ("target", "both"):
        return Meaning("feature", mix(asked).role)  # a network makes no photograph of one
    if any(map(_is_unlisted, references)) or (is_member and not references):
        return None
    images = [meaning for meaning in asked if meaning.kind == "image"]
    if not images:
        kinds = ("depth", "channel", "normal", "flow", *(["feature"] if asked and asked[0].role == "target" else []))
        return asked[0] if len(asked) == 1 and asked[0].kind in kinds else None
    bodies = [returned(target) for target in (each.target for each in references) if isinstance(target, Function)]
    changes = any(is_of_neighbours(part) for body in bodies if body is not None for part in attribute_chain(body))
    made, of = meaning_returned(call) or UNKNOWN, mix(images)
    is_other = made.kind == "logarithm" or (made.kind == "feature" and made.role in ("target", "both"))
    return of._replace(kind="gradient" if changes else made.kind if is_other else of.kind)


def is_of_neighbours(node: ast.AST, value_of: Callable[[ast.AST], Optional[ast.AST]] = lambda _: None) -> bool:
    """Return whether it is a change in one picture: between shifted parts, ``x[1:] - x[:-1]``, or ``x - blur(x)``."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Sub):
        return False
    left, right = node.left, value_of(node.right) or node.right
    are_parts = isinstance(left, ast.Subscript) and isinstance(right, ast.Subscript) and same(left.value, right.value)
    first = [arg.value for arg in given(right)[:1]] if isinstance(right, ast.Call) else []
    return are_parts or any(same(part, left) for part in walk_expressions(*first))


def _is_unlisted(reference: Reference) -> bool:
    """Return whether it is made by a library, or an operation of torch that is in no list."""
    name = str(reference.target)
    is_of_torch = reference.kind == "external" and name.startswith("torch.")
    return reference.kind == "made by" or (is_of_torch and name.rpartition(".")[2] not in KEEPS_PICTURES)


def meaning_returned(call: CallReading) -> Optional[Meaning]:
    """Return what the called function returns."""
    keyed = _keyed(call)
    if keyed is not None:
        return keyed
    for reference in call.program.resolve(call.function, call.node.func):
        for target in call.program.run_by(reference):
            found = [call.meaning_of(target, value) for value in target.flow.returns]
            if found and UNKNOWN not in found:
                return mix(found)
    return None


def _of_owner(call: CallReading) -> Optional[Meaning]:
    kind = kind_of_words(call.name)
    return Meaning(kind, call.ask(call.owner).role if kind and call.owner is not None else None)


_SURE = (_number, _reduced, _filtered, _moved, _on_another_scale, _keyed, _rendered, _named)
