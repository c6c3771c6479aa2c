"""Find what an expression depicts in a training step: which kind of image, and whether it was rendered.

The evidence is the dataflow (where a value comes from, through assignments, clamps, indexing, exposure, ``.cuda()``)
and the field's words in the names along it. A name with "depth" or "feature" outweighs one with "image":
``gt_image = cam.depth`` is a depth.
"""

from __future__ import annotations

import ast
from typing import FrozenSet, List, Optional, Sequence, Tuple

from legs_adapters.code.calls import callees, sure_calls, values_of
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.questions import Questions
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.returned import default_key, formatted_key
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    constant,
    dotted,
    entries,
    given,
    indices,
    key_of,
    root_of,
    same,
    walk_expressions,
    words,
)
from legs_adapters.lexicon.calls import CallReading, is_of_neighbours, meaning_of_call, picked_from
from legs_adapters.lexicon.meaning import UNKNOWN, Meaning, mix, more_special
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.words import BACKGROUND, DATA, KIND_OF, LOSS, RENDER
from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.operations import CONCATENATES

_LITERALS = (ast.Dict, ast.List, ast.Tuple)
_Argument = Tuple[Function, ast.Call, Optional[ast.expr]]  # with the call, and the function around it


class Meanings:
    """Answer for the expressions of one program.

    Args:
        program, training: the program, and what its backward passes depend on.
    """

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self.questions: Questions = Questions()

    def meaning(self, function: Function, node: ast.AST) -> Meaning:
        """Return the meaning of an expression."""
        return self.questions.answer(function, node, self._of, UNKNOWN)

    def origin(self, function: Function, node: ast.AST) -> Meaning:
        """Return the meaning from a name's definitions, without the name itself."""
        while isinstance(node, ast.Subscript) and not isinstance(key_of(node), str):
            node = node.value
        return self._flow(function, node) if isinstance(node, ast.Name) else self.meaning(function, node)

    def _flow(self, function: Function, node: ast.AST) -> Meaning:
        """Join the meanings of the definitions that reach this use."""
        found = self.program.lookup(function, node)
        return self._joined(self._reached(*found) if found is not None else frozenset())

    def _reached(self, function: Function, reaching: Reaching) -> FrozenSet[Meaning]:
        return self.questions.answer(function, reaching, self._ways, frozenset())

    def _joined(self, ways: FrozenSet[Meaning]) -> Meaning:
        """Return the meaning of what can come by several ways."""
        if any(meaning.role == "target" and meaning.kind in ("image", None) for meaning in ways):
            # or what a setting puts into the photograph's place
            ways = frozenset(meaning for meaning in ways if meaning.kind not in ("warp", "feature"))
        return mix(ways)

    # -- expressions

    def _of(self, function: Function, node: ast.AST) -> Meaning:
        if isinstance(node, ast.Name):
            return self._name(function, node, self._flow(function, node))
        if isinstance(node, ast.Attribute):
            return self._member(function, node, node.attr)
        if isinstance(node, ast.Subscript):
            return self._subscript(function, node)
        if isinstance(node, ast.Call):
            table = _table_of(function, node)
            if table is not None:
                return mix(self.meaning(function, each) for each in table.values)
            return meaning_of_call(CallReading(self.program, function, node, self.meaning))
        if isinstance(node, ast.Compare):
            return Meaning("mask", None)
        if is_of_neighbours(node, function.flow.value_of):
            return Meaning("gradient", self.meaning(function, node.left).role)  # type: ignore[attr-defined]
        parts = [self.meaning(function, part) for part in parts_of(node)]
        is_change = isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and len(parts) == 2
        pictures = parts[0].kind in ("image", "logarithm") if is_change else False
        if pictures and parts[0] == parts[1] and parts[0].role:  # of two views or moments
            return Meaning("gradient", parts[0].role)
        return mix(parts, isinstance(node, ast.BinOp))

    def _name(self, function: Function, node: ast.Name, flow: Meaning) -> Meaning:
        """Return the meaning of a name, of its words and of what is assigned to it."""
        shown = "image_" if flow.kind == "image" else ""
        kind, role = kind_of_words(shown + node.id), role_of_words(node.id)
        role = role or flow.role
        if kind == "mask" and flow.kind in ("flow", "depth", "channel"):
            return Meaning("mask", role)  # motion_masks, alpha = depth_sil[1]: to be laid over a rendering
        return Meaning(more_special(kind, flow.kind), role)

    def _subscript(self, function: Function, node: ast.Subscript) -> Meaning:
        key = key_of(node) or formatted_key(node) or default_key(function, node)
        if is_fourth(node) or self._is_behind(function, node):
            return Meaning("channel", self.meaning(function, node.value).role)  # of RGB+D: render[..., 3], render[3:]
        keys = [key] if isinstance(key, str) else self._keys(function, indices(node)[-1])
        if keys:
            return mix(self._member(function, node, each) for each in keys)
        return self._first(function, node.value, _cut(node) in ((None, 3), (0, 3)))

    def _first(self, function: Function, node: ast.AST, is_cut: bool) -> Meaning:
        """Return the meaning of a value; of what is cut off it that of its first part: ``cat([image, depth])[:3]``."""
        whole = function.flow.value_of(node) or node
        made = [(function, whole), *values_of(self.program, function, whole)] if is_cut else []
        joins = [(by, call) for by, call in made if isinstance(call, ast.Call) and call_name(call) in CONCATENATES]
        firsts = [(by, part) for by, call in joins for part in parts_of(given(call)[0].value)[:1]]
        return mix(self.meaning(*first) for first in firsts) if firsts else self.meaning(function, node)

    def _is_behind(self, function: Function, node: ast.Subscript) -> bool:
        """Return whether one channel behind the colours is taken: ``x[3]``, ``x[-1:]``, ``x.split([3, 1])[1]``."""
        taken = indices(node)
        if len(taken) > 1 and isinstance(taken[-1], ast.Slice) and _cut(node) == (-1, None):
            return self.meaning(function, node.value) != UNKNOWN  # no last sample of a ray: ends[..., -1:, 0]
        index = taken[0] if len(taken) == 1 else None
        is_last = isinstance(index, ast.Slice) and index.upper is None and constant(index.lower) == -1
        at = -1 if is_last else constant(index)
        if isinstance(node.value, ast.Call) and isinstance(at, int):
            return picked_from(node.value, at) >= 3
        held = function.flow.value_of(node.value) or node.value  # a list or a batch has whole images: images[-1]
        return at in (3, -1) and isinstance(held, ast.Subscript) and isinstance(key_of(held), str)

    def _keys(self, function: Function, index: ast.expr) -> List[str]:
        """Return the kinds of pictures that an index takes: in a loop over a literal, or by its function's calls."""
        values: List[Optional[ast.AST]] = []
        keys: List[object] = []
        for made in function.flow.reaching(index):
            if made.kind == "parameter":
                values += [function.given(call, made.place) for _, call in self.training.sites.get(function, ())]
            looped = list(walk_expressions(made.value)) if made.kind == "element" and made.value is not None else []
            tables = [table for part in looped for table in function.flow.assigned(part)]
            held = [part for table in tables if isinstance(table, _LITERALS) for part in walk_expressions(table)]
            values += looped + held
            keys += [stored.key for part in looped for stored in function.flow.reaching(part) if stored.kind == "store"]
        keys += map(constant, values)
        return [key for key in keys if isinstance(key, str) and kind_of_words(key) is not None]

    def _member(self, function: Function, node: ast.Attribute | ast.Subscript, name: str) -> Meaning:
        """Return the meaning of an attribute or an entry: of its words, what is assigned to it, and who holds it."""
        local = self._kept(function, node)
        role = role_of_words(name) or local.role
        if role is None and not BACKGROUND & set(words(name)):
            role = self._role_of_holder(function, node.value)
        return Meaning(more_special(kind_of_words(name), local.kind), role)

    def _kept(self, function: Function, node: ast.Attribute | ast.Subscript) -> Meaning:
        """Return the meaning of what is assigned to a member here, or to ``self.name`` anywhere in its class."""
        local = self._flow(function, node) if function.flow.reaching(node) else UNKNOWN
        own = node.attr if isinstance(node, ast.Attribute) and dotted(node.value) == "self" else ""
        owner = self.program.owner_of(function) if own and local == UNKNOWN else None
        stores = owner.stores(own)[:6] if owner is not None else []
        kept = [self._definition(*each) for each in stores]
        table = function.flow.value_of(node.value)
        literal = entries(table) if table is not None and local == UNKNOWN else ()
        kept += [self.meaning(function, value) for key, value in literal if constant(key) == key_of(node)]
        return self._joined(frozenset(kept)) if kept else local

    def _role_of_holder(self, function: Function, node: ast.AST) -> Optional[str]:
        """Return the role from the container: ``outputs["rgb"]`` is rendered, ``batch["rgb"]`` a target."""
        if isinstance(node, ast.Subscript):
            return self._role_of_holder(function, node.value)
        if not isinstance(node, (ast.Name, ast.Attribute)):
            return self.meaning(function, node).role
        name = root_of(node)
        role = role_of_words(name)
        if role is None and set(words(name)) & DATA:
            return "target"  # a camera may have been anywhere before
        if isinstance(node, ast.Attribute):
            return role or self._role_of_holder(function, node.value)
        return role or self._flow(function, node).role

    # -- definitions

    def _ways(self, function: Function, reaching: Reaching) -> FrozenSet[Meaning]:
        """Return the meanings of definitions, each once."""
        if isinstance(reaching, Definition):
            return frozenset([self._definition(function, reaching)])
        return frozenset().union(*(self._reached(function, part) for part in reaching.parts))

    def _definition(self, function: Function, definition: Definition) -> Meaning:
        value = definition.value
        if definition.kind == "parameter":
            return self._parameter(function, definition)
        if value is None or definition.kind in ("import", "function", "class"):
            return UNKNOWN
        if isinstance(definition.node, ast.AugAssign) and definition.kind == "augment":
            return mix([self._flow(function, definition.node.target), self.meaning(function, value)])
        if definition.kind == "element" and definition.index is not None:
            meaning = self._element(function, value, definition.index)
            beside = definition.index > 0 and role_of_words(definition.place) == "target"
            return meaning._replace(role=None) if beside else meaning  # image, gt_image = render(...)
        if definition.kind == "part":
            return Meaning(None, self.meaning(function, value).role)
        if definition.kind in ("mutate", "inplace") and isinstance(value, ast.Call):
            return mix(self.meaning(function, part) for part in arguments(value)[0])
        return self.meaning(function, value)

    def _element(self, function: Function, value: ast.AST, index: int) -> Meaning:
        """Return the meaning of an element of what is unpacked."""
        if _table_of(function, value) is not None and index == 1:
            return self.meaning(function, value)
        if not isinstance(value, ast.Call):
            held = function.flow.value_of(value) or value
            literal = parts_of(held) if isinstance(held, (ast.Tuple, ast.List)) else ()
            rows = [parts_of(each) for each in literal if isinstance(each, (ast.Tuple, ast.List))]
            if rows and all(len(row) > index for row in rows):  # for key, gt in (("render", image), ("depth", depth))
                return mix(self.meaning(function, row[index]) for row in rows)
            return Meaning(None, self.meaning(function, value).role)
        positional = arguments(value)[0]
        if picked_from(value, index) >= 3:
            return Meaning("channel", self.meaning(function, value).role)
        if call_name(value) == "zip" and index < len(positional):
            return self.meaning(function, positional[index])
        if call_name(value) == "split" and index == 0 and positional and isinstance(value.func, ast.Attribute):
            of = value.func.value if constant(positional[0]) is not None else positional[0]
            return self._first(function, of, True)
        # A renderer that returns a tuple returns the image first; the rest have names of their own.
        meaning = self.meaning(function, value)
        if meaning.kind == "image" and index > 0:
            return Meaning(None, meaning.role)
        returned = self._returned(function, value, index, by_name=meaning.kind == "image")
        return returned if returned.kind is not None else meaning

    def _returned(self, function: Function, call: ast.Call, index: int, by_name: bool) -> Meaning:
        """Return the meaning of an element of a returned tuple; a renderer's may join depth and colours: by name."""
        found = []
        for callee in callees(self.program, function, call):
            tuples = [value for value in callee.flow.returns if isinstance(value, ast.Tuple)]
            for element in (parts_of(each)[index] for each in tuples if index < len(each.elts)):
                says_image = isinstance(element, ast.Name) and kind_of_words(element.id) == "image"
                meaning = self.meaning(callee, element)
                found.append(meaning._replace(kind="image") if by_name and says_image else meaning)
        return mix(found)

    def _parameter(self, function: Function, definition: Definition) -> Meaning:
        """Return the meaning of a parameter: that of its arguments where training calls the function."""
        if definition.place not in function.parameters:
            return UNKNOWN
        calls = self._given(function, definition.place)
        found = [self.meaning(caller, value) for caller, _, value in calls if value is not None]
        meaning = mix([meaning for meaning in found if meaning.kind == "image"] or found)
        owner = function.owner.name if function.owner is not None else ""
        says_kind = LOSS & set(words(owner)) and kind_of_words(owner) in ("depth", "normal", "flow")
        # What is nearer outweighs it: the parameter's name, or what one method is given that no other overrides.
        is_named = any(KIND_OF.get(word) == "image" and word not in RENDER for word in words(definition.place))
        is_own = any((dotted(call.func) or "").startswith("self.") for _, call, _ in calls)
        says_kind = says_kind and not (is_named or (meaning.kind == "image" and not is_own))
        return meaning._replace(kind=kind_of_words(owner)) if says_kind else meaning

    def _given(self, function: Function, parameter: str) -> List[_Argument]:
        """Return what training, or else what surely calls a function, gives it for a parameter, with each call."""
        calls = self.training.sites.get(function) or list(sure_calls(self.program, function))
        return [(caller, call, function.given(call, parameter)) for caller, call in calls[:12]]


def _table_of(function: Function, node: ast.AST) -> Optional[ast.Dict]:
    """Return the dictionary whose values are gone through: ``targets.values()``, ``targets.items()``."""
    if not isinstance(node, ast.Call) or call_name(node) not in ("values", "items"):
        return None
    table = function.flow.value_of(node.func.value) if isinstance(node.func, ast.Attribute) else None
    return table if isinstance(table, ast.Dict) else None


def parts_of(node: ast.AST) -> List[ast.AST]:
    """Return the parts of an operation whose meanings are those of the whole."""
    if isinstance(node, (ast.BinOp, ast.BoolOp)):
        parts: List[ast.AST] = [node.left, node.right] if isinstance(node, ast.BinOp) else [*node.values]
        has_only_its_shape = isinstance(node.op, ast.Mult) and 0 in map(constant, parts)  # image * 0 + color
        return [] if has_only_its_shape else [part for part in parts if not _is_opacity(part, parts, node.op)]
    if isinstance(node, ast.IfExp):
        return [node.body, node.orelse]
    if isinstance(node, (ast.Tuple, ast.List)):
        return [each.value if isinstance(each, ast.Starred) else each for each in node.elts]
    if isinstance(node, (ast.ListComp, ast.GeneratorExp)):
        return [node.elt]
    return [node.operand] if isinstance(node, ast.UnaryOp) else []


def _cut(node: ast.Subscript) -> Tuple[object, object]:
    """Return where the one cut of a tensor begins and ends; of a block of a matrix, or none, what no channel has."""
    slices = [each for each in indices(node) if isinstance(each, ast.Slice)]
    cuts = [each for each in slices if each.lower or each.upper or each.step]
    return (constant(cuts[0].lower), cuts[0].upper and constant(cuts[0].upper, 0)) if len(cuts) == 1 else (None, None)


def is_fourth(node: ast.AST) -> bool:
    """Return whether it is what lies behind the colours."""
    if not isinstance(node, ast.Subscript):
        return False
    start, end = _cut(node)
    is_one = len(indices(node)) > 1 and constant(indices(node)[-1]) == 3
    return is_one or (start == 3 and (end is None or (isinstance(end, int) and end > 3)))  # no border: 3:-3


def _is_opacity(part: ast.AST, parts: Sequence[ast.AST], operator: ast.AST) -> bool:
    """Return whether a part of an operation is the opacity of a layer: ``1 - layer[3:]``, ``layer[3:] * layer[:3]``."""
    if not is_fourth(part):
        return False
    colours = [each for each in parts if each is not part]
    values = [each.value for each in walk_expressions(*colours) if isinstance(each, ast.Subscript)]
    is_over = any(same(value, part.value) for value in values)  # type: ignore[attr-defined]
    return constant(parts[0]) == 1 if isinstance(operator, ast.Sub) else is_over
