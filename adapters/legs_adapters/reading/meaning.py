"""What an expression stands for in a training step: which kind of picture it is, and whether it was rendered.

The evidence is the dataflow (where a value comes from, through assignments, clamps, indexing, exposure, ``.cuda()``)
and the field's words in the names on the way. A name that says "depth" or "feature" on the way outweighs one
that says "image": ``gt_image = cam.depth`` is a depth.
"""

from __future__ import annotations

from typing import Callable, Dict, Iterable, List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.calls import sure_calls
from legs_adapters.reading.entries import (
    called_makers,
    computed_key,
    default_key,
    formatted_key,
    forward_maker,
    is_asked_for,
    is_loaded,
    stored,
    written,
)
from legs_adapters.reading.flow import Definition
from legs_adapters.reading.module import Function
from legs_adapters.reading.program import Program
from legs_adapters.reading.signs import (
    are_neighbours,
    draws,
    is_box,
    is_cropped,
    is_masked,
    is_taken_from_one,
    passed_on,
)
from legs_adapters.reading.syntax import (
    JOINS,
    arguments,
    call_name,
    constant,
    key_of,
    root_of,
    same,
    walk_expressions,
    words,
)
from legs_adapters.reading.training import Training
from legs_adapters.reading.vocabulary import DATA, KINDS, kind_of_words, role_of_words

__all__ = ["Meaning", "Meanings"]

_PARAMETERS = {"params", "param", "parameters", "variables", "splats", "gauss_params"}
_SAME = {
    "cuda", "cpu", "to", "float", "half", "double", "type", "clone", "contiguous", "detach", "clamp", "clip", "clamp_",
    "clamp_min", "clamp_max", "squeeze", "unsqueeze", "permute", "transpose", "view", "reshape", "flatten", "expand",
    "repeat", "requires_grad_", "mean", "pow", "flip", "T", "type_as", "movedim", "index_select", "masked_fill", "mul",
    "mul_", "add", "sub", "div", "div_", "nan_to_num", "round", "narrow", "view_as", "reshape_as", "copy", "cumsum",
    "roll", "chunk", "split", "sum", "unbind", "select",
}  # fmt: skip
_FIRST = {
    "clamp", "clip", "interpolate", "grid_sample", "pad", "permute", "squeeze", "unsqueeze", "flatten", "reshape",
    "transpose", "sigmoid", "relu", "from_numpy", "tensor", "as_tensor", "mean", "nan_to_num", "rearrange", "resize",
    "movedim", "pow", "index_select", "masked_select", "gather", "avg_pool2d", "flip", "rot90", "einsum", "checkpoint",
    "conv2d", "mul", "where_first", "abs", "array", "enumerate", "iter", "next", "list", "tuple", "reversed", "zip",
    "tqdm", "DataLoader", "deepcopy", "no_grad", "max_pool2d", "center_crop", "crop", "gaussian_blur",
}  # fmt: skip
_RENDERERS = {
    "render", "rendering", "rasterize", "rasterization", "rasterizer", "renderer", "raster", "splat", "splatting",
}  # fmt: skip
_MODULES = {"torch", "F", "np", "nn", "einops", "functional", "TF"}
_NUMBERS = {"int", "float", "len", "bool"}
_STATISTICS = {"histc", "histogram", "bincount", "entropy", "gram", "moments"}  # of a picture, no picture
_MATCHED = {"match", "matching", "matched", "equalize", "equalized"}  # histogram_matching(image, photo) is one
_EXTREMES = {"max", "min", "amax", "amin"}
_BACKGROUND = {"bg", "bkgd", "background", "backgrounds"}  # a colour to lay things over, whoever keeps it
_OF_DIFFUSION = {"guidance_scale", "negative_prompt", "num_inference_steps", "strength"}  # of a picture that it paints
_LOSSES = {"loss", "losses", "criterion"}
_COMPARED = {"image", "depth", "normal", "flow"}
_STEPS_OR_DYNAMIC = {"dx", "dy"}
_DEPTH = 40
_BUDGET = 20000  # steps to answer one question: some code is one large knot


class Meaning(NamedTuple):
    """``kind``: image, depth, normal, ... or None; ``role``: "render", "target", "both" or None."""

    kind: Optional[str]
    role: Optional[str]


_UNKNOWN = Meaning(None, None)
_Question = Tuple[str, int]  # of an expression, or of the definitions that reach it; its id


class Meanings:
    """Answers for the expressions of one program."""

    def __init__(self, program: Program, training: Training) -> None:
        self.program = program
        self.training = training
        self._known: Dict[_Question, Meaning] = {}
        self._here: Dict[_Question, Meaning] = {}
        self._calls: Dict[Function, List[Tuple[Function, cst.Call]]] = {}
        self._open: Set[_Question] = set()
        self._spent = 0

    def of(self, function: Function, node: cst.CSTNode, depth: int = 0) -> Meaning:
        """Return what an expression stands for."""
        return self._asked(("expression", id(node)), function, node, depth, self._of)

    def _asked(
        self,
        question: _Question,
        function: Function,
        node: cst.CSTNode,
        depth: int,
        answer: Callable[[Function, cst.CSTNode, int], Meaning],
    ) -> Meaning:
        """Answer a question once: what depends on itself, or on too much, is unknown."""
        if question in self._known:
            return self._known[question]
        if question in self._here:
            return self._here[question]
        if question in self._open or depth > _DEPTH or self._spent > _BUDGET:
            return _UNKNOWN
        outermost = not self._open
        self._spent = 0 if outermost else self._spent + 1
        self._open.add(question)
        try:
            meaning = answer(function, node, depth + 1)
        finally:
            self._open.discard(question)
        # What was found inside of a loop is incomplete: it serves this question only.
        self._here[question] = meaning
        if outermost:
            self._known[question] = meaning
            self._here.clear()
        return meaning

    def origin(self, function: Function, node: cst.CSTNode) -> Meaning:
        """Return what a name's definitions say of it, whatever the name itself says."""
        return self._flow(function, node, 0) if isinstance(node, cst.Name) else self.of(function, node)

    def _of(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        if isinstance(node, cst.Name):
            flow = self._flow(function, node, depth)
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
            return self._call(function, node, depth)
        if isinstance(node, cst.BinaryOperation):
            if isinstance(node.operator, cst.Subtract) and are_neighbours(node.left, node.right):
                return Meaning("gradient", self.of(function, node.left, depth).role)
            return _mix([self.of(function, node.left, depth), self.of(function, node.right, depth)])
        if isinstance(node, cst.Comparison):
            return Meaning("mask", None)
        if isinstance(node, cst.UnaryOperation):
            return self.of(function, node.expression, depth)
        if isinstance(node, cst.IfExp):
            return _mix([self.of(function, node.body, depth), self.of(function, node.orelse, depth)])
        if isinstance(node, cst.BooleanOperation):
            return _mix([self.of(function, node.left, depth), self.of(function, node.right, depth)])
        if isinstance(node, (cst.Tuple, cst.List)):
            return _mix([self.of(function, element.value, depth) for element in node.elements])
        if isinstance(node, (cst.ListComp, cst.GeneratorExp)):
            return self.of(function, node.elt, depth)
        return _UNKNOWN

    @staticmethod
    def _named(name: str, flow: Meaning) -> Meaning:
        kind = kind_of_words(name)
        if kind == "gradient" and flow.kind == "image" and set(words(name)) & _STEPS_OR_DYNAMIC:
            return Meaning("image", role_of_words(name) or flow.role)  # dy_tensor = package["render_dy"]
        if kind == "image" and flow.kind == "feature":
            return Meaning("image", role_of_words(name) or flow.role)  # `rgb = outputs["features"]`: colours, there
        if kind == "mask" and flow.kind in ("flow", "depth"):
            # motion_masks, alpha = depth_sil[1]: to be laid over a rendering
            return Meaning("mask", role_of_words(name) or flow.role)
        kinds = [k for k in (kind, flow.kind) if k is not None]
        return Meaning(min(kinds, key=KINDS.index) if kinds else None, role_of_words(name) or flow.role)

    def _flow(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        """Join what the definitions say that reach this use."""
        return self._asked(("definitions", id(node)), function, node, depth, self._defined)

    def _defined(self, function: Function, node: cst.CSTNode, depth: int) -> Meaning:
        definitions = self.program.lookup(function, node)
        if definitions is None:
            return _UNKNOWN
        ways = [self._definition(where, definition, depth) for where, definition in definitions]
        photographs = [meaning for meaning in ways if meaning.role == "target" and meaning.kind in ("image", None)]
        if photographs:  # or what a setting puts into their place
            ways = [meaning for meaning in ways if meaning.kind not in ("warp", "feature")]
        return _mix(ways)

    def _definition(self, function: Function, definition: Definition, depth: int) -> Meaning:
        value = definition.value
        if definition.kind == "parameter":
            return self._parameter(function, definition, depth)
        if value is None or definition.kind in ("import", "function", "class"):
            return _UNKNOWN
        if definition.kind == "augment":
            assert isinstance(definition.node, cst.AugAssign)
            old = self._flow(function, definition.node.target, depth)
            return _mix([old, self.of(function, value, depth)])
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
            return _mix([self.of(function, part, depth) for part in inner])
        return self.of(function, value, depth)

    def _element(self, function: Function, value: cst.CSTNode, index: int, depth: int) -> Meaning:
        if isinstance(value, cst.Call):
            name = call_name(value)
            positional, _, _ = arguments(value)
            if name == "zip" and index < len(positional):
                return self.of(function, positional[index], depth)
            if name == "enumerate":
                return self.of(function, positional[0], depth) if index == 1 and positional else _UNKNOWN
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
        """What an element of a returned tuple is: of a renderer's, which may join a depth to its colours, by name."""
        found = []
        for reference in self.program.resolve(function, call.func):
            if reference.kind == "function" and isinstance(reference.target, Function) and not reference.guess:
                for value in reference.target.flow.returns:
                    if isinstance(value, cst.Tuple) and index < len(value.elements):
                        element = value.elements[index].value
                        passed = passed_on(reference.target, element)
                        given = reference.target.given(call, passed) if passed is not None else None
                        where, what = (reference.target, element) if given is None else (function, given)
                        meaning = self.of(where, what, depth)
                        says_image = isinstance(what, cst.Name) and kind_of_words(what.value) == "image"
                        found.append(meaning._replace(kind="image") if by_name and says_image else meaning)
        return _mix(found)

    def _parameter(self, function: Function, definition: Definition, depth: int) -> Meaning:
        """A parameter is what it is given where training calls the function."""
        if definition.place not in function.parameters:
            return _UNKNOWN
        found = []
        for caller, call in (self.training.sites.get(function) or self._calls_of(function))[:12]:
            value = function.given(call, definition.place)
            if value is not None:
                found.append(self.of(caller, value, depth))
        images = [meaning for meaning in found if meaning.kind == "image"]
        given = _mix(images or found)
        said = self._said_by_class(function)
        return given if said is None else given._replace(kind=said)

    def _said_by_class(self, function: Function) -> Optional[str]:
        """What a loss class's name says that its method is given, where one call in a base class serves several."""
        owner = function.owner
        if owner is None or not set(words(owner.name)) & _LOSSES:
            return None
        if not any(self.program.member(base, function.name) for base in self.program.bases(owner)):
            return None
        kind = kind_of_words(owner.name)
        return kind if kind in _COMPARED else None

    def _calls_of(self, function: Function) -> List[Tuple[Function, cst.Call]]:
        """The calls of a function that training does not go through."""
        if function not in self._calls:
            self._calls[function] = list(sure_calls(self.program, function))
        return self._calls[function]

    def _attribute(self, function: Function, node: cst.Attribute, depth: int) -> Meaning:
        name = node.attr.value
        if isinstance(node.value, cst.Name) and node.value.value in _PARAMETERS:
            return Meaning("parameter", None)
        local = self._flow(function, node, depth) if function.flow.reaching(node) else _UNKNOWN
        if local == _UNKNOWN and isinstance(node.value, cst.Name) and node.value.value == "self":
            owner = self.program.owner_of(function)
            stores = owner.stores(name) if owner is not None else []
            local = _mix([self._definition(method, d, depth) for method, d in stores[:6]])
        kind = kind_of_words(name)
        if kind is None and name in ("T", "data", "grad", "real"):
            return self.of(function, node.value, depth)
        role = role_of_words(name) or local.role
        if role is None or role == "target":
            role = role or self._role_of_holder(function, node.value, depth)
        return Meaning(_closer(kind, local.kind), role)

    def _subscript(self, function: Function, node: cst.Subscript, depth: int) -> Meaning:
        key = key_of(node) or formatted_key(node) or default_key(function, node)
        if isinstance(node.value, (cst.Name, cst.Attribute)) and root_of(node.value) in _PARAMETERS:
            return Meaning("parameter", None)
        if isinstance(key, str):
            here = bool(function.flow.reaching(node))
            local = self._flow(function, node, depth) if here else self._entry(function, node.value, key, depth)
            role = role_of_words(key) or local.role
            if role == "render" and not here and is_asked_for(key) and is_loaded(function, node.value, key):
                role = "target"
            if role is None and not _BACKGROUND & set(words(key)):
                role = self._role_of_holder(function, node.value, depth)
            return Meaning(_closer(kind_of_words(key), local.kind), role)
        computed = computed_key(function, node)
        if computed is not None:  # which entry that is only the words in its key can say, or the holder's own name
            name = root_of(node.value) if isinstance(node.value, (cst.Name, cst.Attribute)) else ""
            kind = kind_of_words(computed) or kind_of_words(name)
            return Meaning(kind, role_of_words(computed) or self._role_of_holder(function, node.value, depth))
        return self.of(function, node.value, depth)

    def _entry(self, function: Function, node: cst.CSTNode, key: str, depth: int) -> Meaning:
        """``package["photo"]``, of a package that the codebase's own function made.

        What a renderer writes into its dictionary has the names that the loss knows; inside, it is made of depths, too.
        """
        held = stored(called_makers(self.program, function, node), key)
        held = held or written(forward_maker(function, node), key)
        return _mix([self.of(maker, value, depth) for maker, value in held])

    def _role_of_holder(self, function: Function, node: cst.CSTNode, depth: int) -> Optional[str]:
        """``outputs["rgb"]`` was rendered, ``batch["rgb"]`` and ``viewpoint.image`` were photographed."""
        if isinstance(node, cst.Name):
            found = set(words(node.value))
            name_role = role_of_words(node.value)
            if name_role is not None:
                return name_role
            if found & DATA and not self._is_rendered(function, node):
                return self._given_role(function, node) or "target"  # a camera may have been anywhere before
            return self._flow(function, node, depth + 1).role
        if isinstance(node, cst.Attribute):
            role = role_of_words(node.attr.value)
            return role or (
                "target"
                if set(words(node.attr.value)) & DATA
                else self._role_of_holder(function, node.value, depth + 1)
            )
        if isinstance(node, cst.Subscript):
            return self._role_of_holder(function, node.value, depth + 1)
        return self.of(function, node, depth).role

    def _given_role(self, function: Function, node: cst.Name) -> Optional[str]:
        """The role of a parameter ``data`` that is given ``data["render_results"]`` wherever training calls it."""
        if {definition.kind for definition in function.flow.reaching(node)} != {"parameter"}:
            return None
        given = [function.given(call, node.value) for _, call in self.training.sites.get(function, [])]
        keys = [key_of(value) for value in given if isinstance(value, cst.Subscript)]
        said = [isinstance(key, str) and bool(set(words(key)) & _RENDERERS) for key in keys]
        return "render" if said and all(said) and len(said) == len(given) else None

    @staticmethod
    def _is_rendered(function: Function, node: cst.Name) -> bool:
        """``view = render(camera)``; not ``data = render(data)``, which has what it had before, too."""
        made = [definition.value for definition in function.flow.reaching(node)]
        return any(
            isinstance(call, cst.Call)
            and bool(set(words(call_name(call))) & _RENDERERS)
            and not any(same(part, node) for arg in call.args for part in walk_expressions(arg.value))
            for call in made
        )

    def _call(self, function: Function, node: cst.Call, depth: int) -> Meaning:
        name = call_name(node)
        positional, keywords, _ = arguments(node)
        values = [*positional, *keywords.values()]
        base = node.func.value if isinstance(node.func, cst.Attribute) else None
        module = isinstance(base, cst.Name) and (base.value in _MODULES or self._imported(function, base))
        if name == "get" and positional and isinstance(constant(positional[0]), str) and base is not None:
            key = constant(positional[0])
            role = role_of_words(key) or self._role_of_holder(function, base, depth)
            return Meaning(kind_of_words(key), role)
        if "prompt" in keywords and _OF_DIFFUSION & set(keywords):
            return Meaning("warp", None)
        if (base is None and name in _NUMBERS) or (base is not None and name == "item"):
            return _UNKNOWN
        if name in _EXTREMES and (base is not None or positional):
            of, axes = (positional[0], positional[1:]) if module or base is None else (base, positional)
            meaning = self.of(function, of, depth)
            if meaning.kind == "image" and ("dim" in keywords or isinstance(constant(axes[0] if axes else None), int)):
                return meaning._replace(kind="parameter")  # the brightest channel of a photograph: a prior
            return meaning
        if name == "where" and len(values) == 3:
            return _mix([self.of(function, value, depth) for value in values[1:]])
        if set(words(name)) & _STATISTICS and not set(words(name)) & _MATCHED and values:
            return Meaning("feature", self.of(function, values[0], depth).role)
        filters = name in ("conv2d", "filter2d", "spatial_gradient") and values and "stride" not in keywords
        if filters and not (len(positional) > 1 and is_box(function, positional[1])):
            return Meaning("gradient", self.of(function, values[0], depth).role)
        if name in JOINS and values:
            return self.of(function, values[0], depth)
        if base is not None and not module and name in _SAME:
            return self.of(function, base, depth)
        if (module or base is None) and (name in _FIRST or name in _SAME) and values:
            return self.of(function, values[0], depth)
        if base is not None and name in ("pop", "popleft", "__getitem__", "cuda"):
            return self.of(function, base, depth)
        spoken = set(words(name))
        kind = kind_of_words(name)
        if "compute" in spoken and kind is None:
            spoken = spoken - {"compute"}
        if spoken & _RENDERERS or (kind is None and draws(values)):
            of_points = kind in (None, "parameter")  # points_to_render(...)
            return Meaning("image" if of_points else kind, "render")
        if kind is not None and kind not in ("image", "mask", "parameter"):
            return Meaning(kind, role_of_words(name))
        if kind == "image" and (role_of_words(name) == "target" or spoken & {"load", "read", "get", "open", "fetch"}):
            holder = self._role_of_holder(function, base, depth) if base is not None else None
            return Meaning("image", role_of_words(name) or holder or "target")
        # A function of an image is an image, unless its name says otherwise: exposure, appearance, a background.
        parts = [self.of(function, value, depth) for value in values]
        images = [part for part in parts if part.kind == "image"]
        if images:
            return _mix(images)
        if isinstance(node.func, cst.Call):  # Renderer(settings)(**means)
            return self.of(function, node.func, depth)
        if isinstance(node.func, (cst.Name, cst.Attribute)):
            made = self._made_by(function, node.func, depth)
            if made is not None:
                return made
        if base is not None and not module:
            return Meaning(kind, self.of(function, base, depth).role if kind else None)
        return Meaning(kind, None)

    def _imported(self, function: Function, node: cst.Name) -> bool:
        """Whether a name is a module's, ``th`` of ``import torch as th``."""
        definitions = self.program.lookup(function, node)
        return bool(definitions) and all(isinstance(d.value, cst.Import) for _, d in definitions or ())

    def _made_by(self, function: Function, node: cst.CSTNode, depth: int) -> Optional[Meaning]:
        """``rasterizer = GaussianRasterizer(...)``, then ``rasterizer(...)``; a function whose returns are images."""
        for reference in self.program.resolve(function, node):
            if reference.kind in ("instance", "class", "made by", "external", "function"):
                name = getattr(reference.target, "name", str(reference.target))
                if set(words(name)) & {"renderer", "rasterizer", "rasterization", "render", "rasterize"}:
                    return Meaning("image", "render")
            if reference.kind == "function" and isinstance(reference.target, Function) and not reference.guess:
                found = [self.of(reference.target, value, depth) for value in reference.target.flow.returns]
                if found and all(m.kind is not None or m.role is not None for m in found):
                    return _mix(found)
        return None


def _is_called_for_another(value: cst.CSTNode, place: str, kind: Optional[str]) -> bool:
    """Whether the kind is only in a function's name, and the name of this one of its results says image."""
    named = isinstance(value, cst.Call) and kind is not None and kind_of_words(call_name(value)) == kind
    return named and kind != "image" and kind_of_words(place) == "image"


def _closer(word: Optional[str], flow: Optional[str]) -> Optional[str]:
    kinds = [kind for kind in (word, flow) if kind is not None]
    return min(kinds, key=KINDS.index) if kinds else None


def _mix(parts: Iterable[Meaning]) -> Meaning:
    """Join the meanings of an expression's parts: a mask or a number laid over an image leaves an image."""
    known = [part for part in parts if part != _UNKNOWN]
    if not known:
        return _UNKNOWN
    pictures = [part for part in known if part.kind not in (None, "mask", "parameter")]
    if pictures:
        kind = min((part.kind for part in pictures if part.kind is not None), key=KINDS.index)
        roles = {part.role for part in pictures if part.role is not None}
    else:
        kinds = [part.kind for part in known if part.kind is not None]
        kind = min(kinds, key=KINDS.index) if kinds else None  # type: ignore[assignment]
        roles = {part.role for part in known if part.role is not None}
    role = roles.pop() if len(roles) == 1 else "both" if roles else None
    return Meaning(kind, role)
