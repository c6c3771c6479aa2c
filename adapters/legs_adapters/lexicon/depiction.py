"""Find what an expression depicts in a training step: which kind of image, and whether it was rendered.

The evidence is the dataflow (where a value comes from, through assignments, clamps, indexing, exposure, ``.cuda()``)
and the field's words in the names along it. A name with "depth" or "feature" outweighs one with "image":
``gt_image = cam.depth`` is a depth.
"""

from __future__ import annotations

from typing import Callable, Dict, List, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.calls import callees, sure_calls
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.returned import (
    called_makers,
    computed_key,
    default_key,
    formatted_key,
    forward_maker,
    passed_on,
    stored,
    written,
)
from legs_adapters.code.syntax import arguments, call_name, constant, key_of, root_of, words
from legs_adapters.lexicon.depicted_calls import meaning_of_call
from legs_adapters.lexicon.holders import role_of_holder
from legs_adapters.lexicon.meaning import UNKNOWN, Meaning, mix, more_special
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.usage import (
    are_neighbours,
    is_asked_for,
    is_cropped,
    is_loaded,
    is_masked,
    is_taken_from_one,
)
from legs_adapters.lexicon.words import (
    BACKGROUND,
    COMPARED,
    KINDS,
    LOSS_CLASS,
    PARAMETERS,
    STEPS_OR_DYNAMIC,
)
from legs_adapters.tensors.backward import Training

__all__ = ["Meanings"]

_DEPTH = 40
_BUDGET = 20000  # steps for one question: some dataflow is one large cycle


_Question = Tuple[str, int]  # of an expression, or of the definitions that reach it; its id


class Meanings:
    """Answer for the expressions of one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._known: Dict[_Question, Meaning] = {}
        self._here: Dict[_Question, Meaning] = {}
        self._calls: Dict[Function, List[Tuple[Function, cst.Call]]] = {}
        self._open: Set[_Question] = set()
        self._spent = 0

    def of(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Meaning:
        """Return the meaning of an expression."""
        return self._asked(("expression", id(node)), function, node, depth, self._of)

    def _asked(
        self,
        question: _Question,
        function: Function,
        node: cst.CSTNode,
        depth: int,
        answer: Callable[[Function, cst.CSTNode, int], Meaning],
    ) -> Meaning:
        """Answer a question once; unknown where the answer depends on itself or exceeds the budget."""
        if question in self._known:
            return self._known[question]
        if question in self._here:
            return self._here[question]
        if question in self._open or depth > _DEPTH or self._spent > _BUDGET:
            return UNKNOWN
        outermost = not self._open
        self._spent = 0 if outermost else self._spent + 1
        self._open.add(question)
        try:
            meaning = answer(function, node, depth + 1)
        finally:
            self._open.discard(question)
        # An answer from inside a cycle is incomplete: it is not cached.
        self._here[question] = meaning
        if outermost:
            self._known[question] = meaning
            self._here.clear()
        return meaning

    def origin(self, function: Function, node: cst.CSTNode) -> Meaning:
        """Return the meaning from a name's definitions, without the name itself."""
        return self.flow(function, node, 0) if isinstance(node, cst.Name) else self.of(function, node)

    def _of(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        if isinstance(node, cst.Name):
            flow = self.flow(function, node, depth)
            if flow.kind == "image" and kind_of_words(node.value) == "gradient" and is_cropped(function, node):
                return flow  # colors_grad = colors[:, :, :half]: the part that gets gradients
            if flow.kind == "image" and kind_of_words(node.value) == "mask" and is_masked(function, node):
                return flow  # gt_mask_images = gt_image * mask
            meaning = self._named(node.value, flow)
            blends = meaning.kind == "feature" and is_taken_from_one(function, node)
            return meaning._replace(kind="mask") if blends else meaning
        if isinstance(node, cst.Attribute):
            return self._attribute(function, node, depth)
        if isinstance(node, cst.Subscript):
            return self._subscript(function, node, depth)
        if isinstance(node, cst.Call):
            return meaning_of_call(self, function, node, depth)
        if isinstance(node, cst.BinaryOperation):
            if isinstance(node.operator, cst.Subtract) and are_neighbours(node.left, node.right):
                return Meaning("gradient", self.of(function, node.left, depth).role)
            return mix([self.of(function, node.left, depth), self.of(function, node.right, depth)])
        if isinstance(node, cst.Comparison):
            return Meaning("mask", None)
        if isinstance(node, cst.UnaryOperation):
            return self.of(function, node.expression, depth)
        if isinstance(node, cst.IfExp):
            return mix([self.of(function, node.body, depth), self.of(function, node.orelse, depth)])
        if isinstance(node, cst.BooleanOperation):
            return mix([self.of(function, node.left, depth), self.of(function, node.right, depth)])
        if isinstance(node, (cst.Tuple, cst.List)):
            return mix([self.of(function, element.value, depth) for element in node.elements])
        if isinstance(node, (cst.ListComp, cst.GeneratorExp)):
            return self.of(function, node.elt, depth)
        return UNKNOWN

    @staticmethod
    def _named(name: str, flow: Meaning) -> Meaning:
        kind = kind_of_words(name)
        if kind == "gradient" and flow.kind == "image" and set(words(name)) & STEPS_OR_DYNAMIC:
            return Meaning("image", role_of_words(name) or flow.role)  # dy_tensor = package["render_dy"]
        if kind == "image" and flow.kind == "feature":
            return Meaning("image", role_of_words(name) or flow.role)  # `rgb = outputs["features"]`: colours, there
        if kind == "mask" and flow.kind in ("flow", "depth"):
            # motion_masks, alpha = depth_sil[1]: to be laid over a rendering
            return Meaning("mask", role_of_words(name) or flow.role)
        kinds = [k for k in (kind, flow.kind) if k is not None]
        return Meaning(min(kinds, key=KINDS.index) if kinds else None, role_of_words(name) or flow.role)

    def flow(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        """Join the meanings of the definitions that reach this use."""
        return self._asked(("definitions", id(node)), function, node, depth, self._defined)

    def _defined(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        definitions = self.program.lookup(function, node)
        if definitions is None:
            return UNKNOWN
        ways = [self._definition(where, definition, depth) for where, definition in definitions]
        photographs = [meaning for meaning in ways if meaning.role == "target" and meaning.kind in ("image", None)]
        if photographs:  # or what a setting puts into their place
            ways = [meaning for meaning in ways if meaning.kind not in ("warp", "feature")]
        return mix(ways)

    def _definition(self, function: Function, definition: Definition, depth: int) -> Meaning:
        value = definition.value
        if definition.kind == "parameter":
            return self._parameter(function, definition, depth)
        if value is None or definition.kind in ("import", "function", "class"):
            return UNKNOWN
        if definition.kind == "augment":
            assert isinstance(definition.node, cst.AugAssign)
            old = self.flow(function, definition.node.target, depth)
            return mix([old, self.of(function, value, depth)])
        if definition.kind == "element" and definition.index is not None:
            meaning = self._element(function, value, definition.index, depth)
            if _is_called_for_another(value, definition.place, meaning.kind):
                meaning = meaning._replace(kind="image")  # flows, image = match_flow(image)
            beside = definition.index > 0 and role_of_words(definition.place) == "target"
            return meaning._replace(role=None) if beside else meaning  # image, gt_image = render(...)
        if definition.kind == "part":
            return Meaning(None, self.of(function, value, depth).role)
        if definition.kind in ("mutate", "inplace", "store"):
            inner = arguments(value)[0] if isinstance(value, cst.Call) and definition.kind != "store" else [value]
            return mix([self.of(function, part, depth) for part in inner])
        return self.of(function, value, depth)

    def _element(self, function: Function, value: cst.CSTNode, index: int, depth: int) -> Meaning:
        if isinstance(value, cst.Call):
            name = call_name(value)
            positional, _, _ = arguments(value)
            if name == "zip" and index < len(positional):
                return self.of(function, positional[index], depth)
            if name == "enumerate":
                return self.of(function, positional[0], depth) if index == 1 and positional else UNKNOWN
            # A renderer that returns a tuple returns the image first; the rest have names of their own.
            meaning = self.of(function, value, depth)
            if meaning.kind == "image" and index > 0:
                return Meaning(None, meaning.role)
            returned = self._returned(function, value, index, depth, by_name=meaning.kind == "image")
            return returned if returned.kind is not None else meaning
        if isinstance(value, (cst.Tuple, cst.List)) and index < len(value.elements):
            return self.of(function, value.elements[index].value, depth)
        meaning = self.of(function, value, depth)
        return Meaning(None, meaning.role)

    def _returned(self, function: Function, call: cst.Call, index: int, depth: int, by_name: bool) -> Meaning:
        """Return the meaning of an element of a returned tuple; a renderer's may join depth and colours: by name."""
        found = []
        for callee in callees(self.program, function, call):
            for value in callee.flow.returns:
                if isinstance(value, cst.Tuple) and index < len(value.elements):
                    element = value.elements[index].value
                    passed = passed_on(callee, element)
                    given = callee.given(call, passed) if passed is not None else None
                    where, what = (callee, element) if given is None else (function, given)
                    meaning = self.of(where, what, depth)
                    says_image = isinstance(what, cst.Name) and kind_of_words(what.value) == "image"
                    found.append(meaning._replace(kind="image") if by_name and says_image else meaning)
        return mix(found)

    def _parameter(self, function: Function, definition: Definition, depth: int) -> Meaning:
        """Return the meaning of a parameter: that of its arguments where training calls the function."""
        if definition.place not in function.parameters:
            return UNKNOWN
        found = []
        for caller, call in (self.training.sites.get(function) or self._calls_of(function))[:12]:
            value = function.given(call, definition.place)
            if value is not None:
                found.append(self.of(caller, value, depth))
        images = [meaning for meaning in found if meaning.kind == "image"]
        given = mix(images or found)
        said = self._said_by_class(function)
        return given if said is None else given._replace(kind=said)

    def _said_by_class(self, function: Function) -> Optional[str]:
        """Return the kind in the name of a loss class, where a call in its base class serves several."""
        owner = function.owner
        if owner is None or not set(words(owner.name)) & LOSS_CLASS:
            return None
        if not any(self.program.member(base, function.name) for base in self.program.bases(owner)):
            return None
        kind = kind_of_words(owner.name)
        return kind if kind in COMPARED else None

    def _calls_of(self, function: Function) -> List[Tuple[Function, cst.Call]]:
        """Return the calls of a function outside of training."""
        if function not in self._calls:
            self._calls[function] = list(sure_calls(self.program, function))
        return self._calls[function]

    def _attribute(self, function: Function, node: cst.Attribute, depth: int) -> Meaning:
        name = node.attr.value
        if isinstance(node.value, cst.Name) and node.value.value in PARAMETERS:
            return Meaning("parameter", None)
        local = self.flow(function, node, depth) if function.flow.reaching(node) else UNKNOWN
        if local == UNKNOWN and isinstance(node.value, cst.Name) and node.value.value == "self":
            owner = self.program.owner_of(function)
            stores = owner.stores(name) if owner is not None else []
            local = mix([self._definition(method, d, depth) for method, d in stores[:6]])
        kind = kind_of_words(name)
        if kind is None and name in ("T", "data", "grad", "real"):
            return self.of(function, node.value, depth)
        role = role_of_words(name) or local.role
        if role is None or role == "target":
            role = role or role_of_holder(self, function, node.value, depth)
        return Meaning(more_special(kind, local.kind), role)

    def _subscript(self, function: Function, node: cst.Subscript, depth: int) -> Meaning:
        key = key_of(node) or formatted_key(node) or default_key(function, node)
        if isinstance(node.value, (cst.Name, cst.Attribute)) and root_of(node.value) in PARAMETERS:
            return Meaning("parameter", None)
        last = node.slice[-1].slice
        if len(node.slice) > 1 and isinstance(last, cst.Index) and constant(last.value) == 3:
            return Meaning("depth", self.of(function, node.value, depth).role)  # of RGB+D, render[0, ..., 3]
        if isinstance(key, str):
            here = bool(function.flow.reaching(node))
            local = self.flow(function, node, depth) if here else self._entry(function, node.value, key, depth)
            role = role_of_words(key) or local.role
            if role == "render" and not here and is_asked_for(key) and is_loaded(function, node.value, key):
                role = "target"
            if role is None and not BACKGROUND & set(words(key)):
                role = role_of_holder(self, function, node.value, depth)
            return Meaning(more_special(kind_of_words(key), local.kind), role)
        computed = computed_key(function, node)
        if computed is not None:  # which entry that is only the words in its key can say, or the holder's own name
            name = root_of(node.value) if isinstance(node.value, (cst.Name, cst.Attribute)) else ""
            kind = kind_of_words(computed) or kind_of_words(name)
            return Meaning(kind, role_of_words(computed) or role_of_holder(self, function, node.value, depth))
        return self.of(function, node.value, depth)

    def _entry(self, function: Function, node: cst.CSTNode, key: str, depth: int) -> Meaning:
        """Return the meaning of ``package["photo"]``, of a package that a function of the codebase returned.

        A renderer's keys say what the entries are; the values inside a renderer are made of depths, too.
        """
        held = stored(called_makers(self.program, function, node), key)
        held = held or written(forward_maker(function, node), key)
        return mix([self.of(maker, value, depth) for maker, value in held])


def _is_called_for_another(value: cst.CSTNode, place: str, kind: Optional[str]) -> bool:
    """Return whether only the function's name has the kind, and the name of this result is an image's."""
    named = isinstance(value, cst.Call) and kind is not None and kind_of_words(call_name(value)) == kind
    return named and kind != "image" and kind_of_words(place) == "image"
