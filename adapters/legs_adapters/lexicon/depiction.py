"""Find what an expression depicts in a training step: which kind of image, and whether it was rendered.

The evidence is the dataflow (where a value comes from, through assignments, clamps, indexing, exposure, ``.cuda()``)
and the field's words in the names along it. A name with "depth" or "feature" outweighs one with "image":
``gt_image = cam.depth`` is a depth.
"""

from __future__ import annotations

from typing import FrozenSet, List, Optional, Tuple

import libcst as cst

from legs_adapters.code.calls import callees, sure_calls, values_of
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.questions import Questions
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.returned import default_key, formatted_key
from legs_adapters.code.syntax import (
    arguments,
    call_name,
    code,
    constant,
    dotted,
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

_LITERALS = (cst.Dict, cst.List, cst.Tuple)
_Argument = Tuple[Function, cst.Call, Optional[cst.BaseExpression]]  # with the call, and the function around it


class Meanings:
    """Answer for the expressions of one program.

    Args:
        program, training: the program, and what its backward passes depend on.
    """

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self.questions: Questions = Questions()

    def meaning(self, function: Function, node: cst.CSTNode) -> Meaning:
        """Return the meaning of an expression."""
        return self.questions.answer(function, node, self._of, UNKNOWN)

    def origin(self, function: Function, node: cst.CSTNode) -> Meaning:
        """Return the meaning from a name's definitions, without the name itself."""
        while isinstance(node, cst.Subscript) and not isinstance(key_of(node), str):
            node = node.value
        return self._flow(function, node) if isinstance(node, cst.Name) else self.meaning(function, node)

    def _flow(self, function: Function, node: cst.CSTNode) -> Meaning:
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

    def _of(self, function: Function, node: cst.CSTNode) -> Meaning:
        if isinstance(node, cst.Name):
            return self._name(function, node, self._flow(function, node))
        if isinstance(node, cst.Attribute):
            return self._member(function, node, node.attr.value)
        if isinstance(node, cst.Subscript):
            return self._subscript(function, node)
        if isinstance(node, cst.Call):
            table = _table_of(function, node)
            if table is not None:
                return mix(self.meaning(function, each.value) for each in table.elements)
            return meaning_of_call(CallReading(self.program, function, node, self.meaning))
        if isinstance(node, cst.Comparison):
            return Meaning("mask", None)
        if is_of_neighbours(node, function.flow.value_of):
            return Meaning("gradient", self.meaning(function, node.left).role)  # type: ignore[attr-defined]
        parts = [self.meaning(function, part) for part in parts_of(node)]
        is_change = isinstance(getattr(node, "operator", None), cst.Subtract) and len(parts) == 2
        pictures = parts[0].kind in ("image", "logarithm") if is_change else False
        if pictures and parts[0] == parts[1] and parts[0].role:  # of two views or moments
            return Meaning("gradient", parts[0].role)
        return mix(parts, isinstance(node, cst.BinaryOperation))

    def _name(self, function: Function, node: cst.Name, flow: Meaning) -> Meaning:
        """Return the meaning of a name, of its words and of what is assigned to it."""
        shown = "image_" if flow.kind == "image" else ""
        kind, role = kind_of_words(shown + node.value), role_of_words(node.value)
        role = role or flow.role
        if kind == "mask" and flow.kind in ("flow", "depth", "channel"):
            return Meaning("mask", role)  # motion_masks, alpha = depth_sil[1]: to be laid over a rendering
        return Meaning(more_special(kind, flow.kind), role)

    def _subscript(self, function: Function, node: cst.Subscript) -> Meaning:
        key = key_of(node) or formatted_key(node) or default_key(function, node)
        if is_fourth(node) or self._is_behind(function, node):
            return Meaning("channel", self.meaning(function, node.value).role)  # of RGB+D: render[..., 3], render[3:]
        keys = [key] if isinstance(key, str) else self._keys(function, node.slice[-1].slice)
        if keys:
            return mix(self._member(function, node, each) for each in keys)
        return self._first(function, node.value, _cut(node) in ((None, 3), (0, 3)))

    def _first(self, function: Function, node: cst.CSTNode, is_cut: bool) -> Meaning:
        """Return the meaning of a value; of what is cut off it that of its first part: ``cat([image, depth])[:3]``."""
        whole = function.flow.value_of(node) or node
        made = [(function, whole), *values_of(self.program, function, whole)] if is_cut else []
        joins = [(by, call) for by, call in made if isinstance(call, cst.Call) and call_name(call) in CONCATENATES]
        firsts = [(by, part) for by, call in joins for part in parts_of(call.args[0].value)[:1]]
        return mix(self.meaning(*first) for first in firsts) if firsts else self.meaning(function, node)

    def _is_behind(self, function: Function, node: cst.Subscript) -> bool:
        """Return whether one channel behind the colours is taken: ``x[3]``, ``x[-1:]``, ``x.split([3, 1])[1]``."""
        if len(node.slice) > 1 and isinstance(node.slice[-1].slice, cst.Slice) and _cut(node) == (-1, None):
            return self.meaning(function, node.value) != UNKNOWN  # no last sample of a ray: ends[..., -1:, 0]
        index = node.slice[0].slice if len(node.slice) == 1 else None
        is_last = isinstance(index, cst.Slice) and index.upper is None and constant(index.lower) == -1
        at = constant(index.value) if isinstance(index, cst.Index) else -1 if is_last else None
        if isinstance(node.value, cst.Call) and isinstance(at, int):
            return picked_from(node.value, at) >= 3
        held = function.flow.value_of(node.value) or node.value  # a list or a batch has whole images: images[-1]
        return at in (3, -1) and isinstance(held, cst.Subscript) and isinstance(key_of(held), str)

    def _keys(self, function: Function, index: cst.CSTNode) -> List[str]:
        """Return the kinds of pictures that an index takes: in a loop over a literal, or by its function's calls."""
        values: List[Optional[cst.CSTNode]] = []
        keys: List[object] = []
        for made in function.flow.reaching(index.value) if isinstance(index, cst.Index) else ():
            if made.kind == "parameter":
                values += [function.given(call, made.place) for _, call in self.training.sites.get(function, ())]
            looped = list(walk_expressions(made.value)) if made.kind == "element" and made.value is not None else []
            tables = [table for part in looped for table in function.flow.assigned(part)]
            held = [part for table in tables if isinstance(table, _LITERALS) for part in walk_expressions(table)]
            values += looped + held
            keys += [stored.key for part in looped for stored in function.flow.reaching(part) if stored.kind == "store"]
        keys += map(constant, values)
        return [key for key in keys if isinstance(key, str) and kind_of_words(key) is not None]

    def _member(self, function: Function, node: cst.Attribute | cst.Subscript, name: str) -> Meaning:
        """Return the meaning of an attribute or an entry: of its words, what is assigned to it, and who holds it."""
        local = self._kept(function, node)
        role = role_of_words(name) or local.role
        if role is None and not BACKGROUND & set(words(name)):
            role = self._role_of_holder(function, node.value)
        return Meaning(more_special(kind_of_words(name), local.kind), role)

    def _kept(self, function: Function, node: cst.Attribute | cst.Subscript) -> Meaning:
        """Return the meaning of what is assigned to a member here, or to ``self.name`` anywhere in its class."""
        local = self._flow(function, node) if function.flow.reaching(node) else UNKNOWN
        own = node.attr.value if isinstance(node, cst.Attribute) and dotted(node.value) == "self" else ""
        owner = self.program.owner_of(function) if own and local == UNKNOWN else None
        stores = owner.stores(own)[:6] if owner is not None else []
        kept = [self._definition(*each) for each in stores]
        table = function.flow.value_of(node.value)
        literal = table.elements if isinstance(table, cst.Dict) and local == UNKNOWN else ()
        named = [each for each in literal if isinstance(each, cst.DictElement) and constant(each.key) == key_of(node)]
        kept += [self.meaning(function, each.value) for each in named]
        return self._joined(frozenset(kept)) if kept else local

    def _role_of_holder(self, function: Function, node: cst.CSTNode) -> Optional[str]:
        """Return the role from the container: ``outputs["rgb"]`` is rendered, ``batch["rgb"]`` a target."""
        if isinstance(node, cst.Subscript):
            return self._role_of_holder(function, node.value)
        if not isinstance(node, (cst.Name, cst.Attribute)):
            return self.meaning(function, node).role
        name = root_of(node)
        role = role_of_words(name)
        if role is None and set(words(name)) & DATA:
            return "target"  # a camera may have been anywhere before
        if isinstance(node, cst.Attribute):
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
        if isinstance(definition.node, cst.AugAssign) and definition.kind == "augment":
            return mix([self._flow(function, definition.node.target), self.meaning(function, value)])
        if definition.kind == "element" and definition.index is not None:
            meaning = self._element(function, value, definition.index)
            beside = definition.index > 0 and role_of_words(definition.place) == "target"
            return meaning._replace(role=None) if beside else meaning  # image, gt_image = render(...)
        if definition.kind == "part":
            return Meaning(None, self.meaning(function, value).role)
        if definition.kind in ("mutate", "inplace") and isinstance(value, cst.Call):
            return mix(self.meaning(function, part) for part in arguments(value)[0])
        return self.meaning(function, value)

    def _element(self, function: Function, value: cst.CSTNode, index: int) -> Meaning:
        """Return the meaning of an element of what is unpacked."""
        if _table_of(function, value) is not None and index == 1:
            return self.meaning(function, value)
        if not isinstance(value, cst.Call):
            held = function.flow.value_of(value) or value
            literal = held.elements if isinstance(held, (cst.Tuple, cst.List)) else ()
            rows = [each.value.elements for each in literal if isinstance(each.value, (cst.Tuple, cst.List))]
            if rows and all(len(row) > index for row in rows):  # for key, gt in (("render", image), ("depth", depth))
                return mix(self.meaning(function, row[index].value) for row in rows)
            return Meaning(None, self.meaning(function, value).role)
        given = arguments(value)[0]
        if picked_from(value, index) >= 3:
            return Meaning("channel", self.meaning(function, value).role)
        if call_name(value) == "zip" and index < len(given):
            return self.meaning(function, given[index])
        if call_name(value) == "split" and index == 0 and given and isinstance(value.func, cst.Attribute):
            return self._first(function, value.func.value if constant(given[0]) is not None else given[0], True)
        # A renderer that returns a tuple returns the image first; the rest have names of their own.
        meaning = self.meaning(function, value)
        if meaning.kind == "image" and index > 0:
            return Meaning(None, meaning.role)
        returned = self._returned(function, value, index, by_name=meaning.kind == "image")
        return returned if returned.kind is not None else meaning

    def _returned(self, function: Function, call: cst.Call, index: int, by_name: bool) -> Meaning:
        """Return the meaning of an element of a returned tuple; a renderer's may join depth and colours: by name."""
        found = []
        for callee in callees(self.program, function, call):
            tuples = [value for value in callee.flow.returns if isinstance(value, cst.Tuple)]
            for element in (each.elements[index].value for each in tuples if index < len(each.elements)):
                says_image = isinstance(element, cst.Name) and kind_of_words(element.value) == "image"
                meaning = self.meaning(callee, element)
                found.append(meaning._replace(kind="image") if by_name and says_image else meaning)
        return mix(found)

    def _parameter(self, function: Function, definition: Definition) -> Meaning:
        """Return the meaning of a parameter: that of its arguments where training calls the function."""
        if definition.place not in function.parameters:
            return UNKNOWN
        given = self._given(function, definition.place)
        found = [self.meaning(caller, value) for caller, _, value in given if value is not None]
        meaning = mix([meaning for meaning in found if meaning.kind == "image"] or found)
        owner = function.owner.name if function.owner is not None else ""
        says_kind = LOSS & set(words(owner)) and kind_of_words(owner) in ("depth", "normal", "flow")
        # What is nearer outweighs it: the parameter's name, or what one method is given that no other overrides.
        is_named = any(KIND_OF.get(word) == "image" and word not in RENDER for word in words(definition.place))
        is_own = any((dotted(call.func) or "").startswith("self.") for _, call, _ in given)
        says_kind = says_kind and not (is_named or (meaning.kind == "image" and not is_own))
        return meaning._replace(kind=kind_of_words(owner)) if says_kind else meaning

    def _given(self, function: Function, parameter: str) -> List[_Argument]:
        """Return what training, or else what surely calls a function, gives it for a parameter, with each call."""
        calls = self.training.sites.get(function) or list(sure_calls(self.program, function))
        return [(caller, call, function.given(call, parameter)) for caller, call in calls[:12]]


def _table_of(function: Function, node: cst.CSTNode) -> Optional[cst.Dict]:
    """Return the dictionary whose values are gone through: ``targets.values()``, ``targets.items()``."""
    if not isinstance(node, cst.Call) or call_name(node) not in ("values", "items"):
        return None
    table = function.flow.value_of(node.func.value) if isinstance(node.func, cst.Attribute) else None
    return table if isinstance(table, cst.Dict) else None


def parts_of(node: cst.CSTNode) -> List[cst.CSTNode]:
    """Return the parts of an operation whose meanings are those of the whole."""
    if isinstance(node, (cst.BinaryOperation, cst.BooleanOperation)):
        parts: List[cst.CSTNode] = [node.left, node.right]
        has_only_its_shape = isinstance(node.operator, cst.Multiply) and 0 in map(constant, parts)  # image * 0 + color
        return [] if has_only_its_shape else [part for part in parts if not _is_opacity(part, node)]
    if isinstance(node, cst.IfExp):
        return [node.body, node.orelse]
    if isinstance(node, (cst.Tuple, cst.List)):
        return [element.value for element in node.elements]
    if isinstance(node, (cst.ListComp, cst.GeneratorExp)):
        return [node.elt]
    return [node.expression] if isinstance(node, cst.UnaryOperation) else []


def _cut(node: cst.Subscript) -> Tuple[object, object]:
    """Return where the one cut of a tensor begins and ends; of a block of a matrix, or none, what no channel has."""
    parts = [each.slice for each in node.slice]
    cuts = [cut for cut in parts if isinstance(cut, cst.Slice) and code(cut) != ":"]
    return (constant(cuts[0].lower), cuts[0].upper and constant(cuts[0].upper, 0)) if len(cuts) == 1 else (None, None)


def is_fourth(node: cst.CSTNode) -> bool:
    """Return whether it is what lies behind the colours."""
    if not isinstance(node, cst.Subscript):
        return False
    start, end = _cut(node)
    last = node.slice[-1].slice if len(node.slice) > 1 else None
    is_one = isinstance(last, cst.Index) and constant(last.value) == 3
    return is_one or (start == 3 and (end is None or (isinstance(end, int) and end > 3)))  # no border: 3:-3


def _is_opacity(part: cst.CSTNode, node: cst.BinaryOperation | cst.BooleanOperation) -> bool:
    """Return whether a part of an operation is the opacity of a layer: ``1 - layer[3:]``, ``layer[3:] * layer[:3]``."""
    if not is_fourth(part):
        return False
    left, right = node.left, node.right
    colours = left if part is right else right
    values = [each.value for each in walk_expressions(colours) if isinstance(each, cst.Subscript)]
    is_over = any(same(value, part.value) for value in values)  # type: ignore[attr-defined]
    return constant(left) == 1 if isinstance(node.operator, cst.Subtract) else is_over
