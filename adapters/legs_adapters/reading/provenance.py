"""Whether a target is a view's own stored image, untouched between loading and the loss: only then may it be named.

The proof wants three things: the target is ``camera.original_image`` (or what the codebase calls it), moved between
devices and types but not changed; ``camera`` is the same view where the name is asked; and the camera's class stores
both the image and ``image_name``.
"""

from __future__ import annotations

import re
from typing import List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.reading.flow import Definition
from legs_adapters.reading.module import Class, Function
from legs_adapters.reading.program import Program
from legs_adapters.reading.syntax import (
    arguments,
    attribute_chain,
    call_name,
    code,
    constant,
    dotted,
    loops_around,
    walk_expressions,
    word_set,
    words,
)

__all__ = ["View", "Views"]

_MOVES = {"cuda", "to", "cpu", "float", "contiguous", "clone", "detach", "type"}
_IMAGES = {"original_image", "image", "gt_image", "rgb", "original_rgb", "img", "image_tensor"}
_NAME = "image_name"
_DEPTH = 4
_NAMING = re.compile(rf"\b{_NAME}\s*=(?!=)")
_OF_LISTS = {"copy", "pop", "popleft"}
_OTHER_CAMERAS = re.compile(r"get(?!Train|Test)\w+Cam(era)?s$")
_POSES = re.compile(r"\bcam_extrinsics\s*=")
_NO_PHOTOGRAPHS = word_set("virtual pseudo fake warped")
_PLACED = re.compile(r"\.source_path\s*=[^=]")  # in the settings that Inria's Scene reads


class View(NamedTuple):
    """The verdict: the text to pass as ``view=``, or None; and the reason, in words."""

    text: Optional[str]
    reason: str


class Views:
    """Verdicts for one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self._cameras: Optional[List[Class]] = None

    def of(self, function: Function, target: cst.CSTNode, site: cst.CSTNode) -> View:
        """Return the verdict for the target of one site."""
        images: List[Tuple[cst.Attribute, Function]] = []
        problem = self._trace(function, target, images, set())
        if problem is not None:
            return View(None, problem)
        if not images:
            return View(None, "not a view's own image")
        if len({(code(image), where) for image, where in images}) != 1:
            return View(None, "comes from several places")
        image, where = images[0]
        holder = image.value
        if where is not function or not isinstance(holder, cst.Name):
            return View(None, f"{code(image)} is not named where the loss is")
        stored = self._stored(image.attr.value)
        if stored is not None:
            return View(None, stored)
        if not self._still(function, holder, target, site):
            return View(None, f"{holder.value} may be another view by then")
        doubt = _overwritten(function, holder.value, image.attr.value) or self._nameless(function, holder, set())
        doubt = doubt or self._remade(function, holder, image.attr.value) or _of_several(function, holder, set())
        doubt = doubt or _of_no_photograph(function, site) or _told_apart(function, holder.value)
        doubt = doubt or self._of_scenes_in_turn(function)
        if doubt is not None:
            return View(None, doubt)
        return View(f"{holder.value}.{_NAME}", f"{code(image)}, untouched")

    def _trace(
        self, function: Function, node: cst.CSTNode, images: List[Tuple[cst.Attribute, Function]], seen: Set[int]
    ) -> Optional[str]:
        """Follow the target to where it is stored; return why that fails, if it does."""
        if isinstance(node, cst.Attribute) and node.attr.value in _IMAGES and dotted(node.value) not in (None, "self"):
            images.append((node, function))
            return None
        if isinstance(node, cst.Name):
            definitions = function.flow.reaching(node)
            if not definitions:
                return f"{node.value} is not made in this function"
            for definition in sorted(definitions, key=lambda d: d.order):
                problem = self._definition(function, definition, images, seen)
                if problem is not None:
                    return problem
            return None
        if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
            name = node.func.attr.value
            if name in _MOVES:
                return self._trace(function, node.func.value, images, seen)
            if name in ("clamp", "clip") and _unit_range(node, 0):
                return self._trace(function, node.func.value, images, seen)
            if dotted(node.func) in ("torch.clamp", "torch.clip") and node.args and _unit_range(node, 1):
                return self._trace(function, node.args[0].value, images, seen)
            if name in ("cat", "stack", "concat"):
                return "batched"
        if isinstance(node, cst.Subscript):
            if _first_channels(node):
                return self._trace(function, node.value, images, seen)
            if isinstance(node.slice[0].slice, cst.Index) and isinstance(constant(node.slice[0].slice.value), str):
                return f"{_short(node)} has no name of its own"
            return self._trace(function, node.value, images, seen) or f"indexed: {_short(node)}"
        if isinstance(node, cst.Call):
            name = call_name(node)
            spoken = set(words(name))
            if spoken & {"interpolate", "resize", "downsample", "avg"}:
                return f"resized by {name}"
            if spoken & {"offset", "shift", "shifted", "warp", "translate", "roll"}:
                return f"shifted by {name}"
            return f"changed by {name or 'a call'}"
        if isinstance(node, cst.BinaryOperation):
            if isinstance(node.operator, (cst.Divide, cst.Multiply)) and constant(node.right) is not None:
                return f"scaled: {_short(node)}"
            return f"composited: {_short(node)}"
        if isinstance(node, cst.IfExp):
            return self._trace(function, node.body, images, seen) or self._trace(function, node.orelse, images, seen)
        return f"not traced: {_short(node)}"

    def _definition(
        self, function: Function, definition: Definition, images: List[Tuple[cst.Attribute, Function]], seen: Set[int]
    ) -> Optional[str]:
        if id(definition) in seen:
            return None
        seen.add(id(definition))
        if definition.kind == "assign" and definition.value is not None:
            return self._trace(function, definition.value, images, seen)
        if definition.kind == "parameter":
            return f"{definition.place} is a parameter"
        if definition.kind in ("augment", "inplace", "store", "mutate"):
            return f"changed in place: {_short(definition.node)}"
        return f"{definition.place} comes out of a batch"

    def _still(self, function: Function, holder: cst.Name, target: cst.CSTNode, site: cst.CSTNode) -> bool:
        """Whether the camera's name at the loss can only be the camera that the target was taken from."""
        then = function.flow.reaching(holder)
        now = function.flow.names_at(site, holder.value)
        return bool(then) and now == then

    def _stored(self, attribute: str) -> Optional[str]:
        if self._cameras is None:
            self._cameras = []
            for module in self.program.matching(re.compile(r"self\.image_name\s*=")):
                self._cameras.extend(c for c in module.classes if c.stores(_NAME))
        if not self._cameras:
            return f"no class of this codebase stores {_NAME}"
        if not any(camera.stores(attribute) or attribute in camera.methods for camera in self._cameras):
            return f"no class of this codebase stores both {attribute} and {_NAME}"
        for camera in self._cameras:
            if attribute in camera.methods and "property" in camera.methods[attribute].decorators:
                return f"{attribute} is computed anew each time"
            for method, _ in camera.stores(_NAME):
                renames = method.name != "__init__" and _NAME in method.parameters
                if renames and self.program.mentioning(method.name, called=True):
                    return f"{method.name} gives a camera another {_NAME}"
        return self._named()

    def _named(self) -> Optional[str]:
        """Why what the cameras get as a name is none of a photograph, if it is none wherever they are made."""
        makers = [
            (function, keywords[_NAME])
            for name in {camera.name for camera in self._cameras or ()}
            for function in self.program.mentioning(name, called=True)
            for call in function.flow.calls
            if call_name(call) == name
            for keywords in (arguments(call)[1],)
            if _NAME in keywords
        ]
        given = [value for function, value in makers if self._is_used(function)] or [value for _, value in makers]
        if given and all(_is_no_name(value) for value in given):
            return f"{_NAME} is {_short(given[0])}"
        for module in self.program.matching(_NAMING):
            for function in module.scopes(_NAMING.search):
                if self._is_used(function) and any(_names_again(function, call) for call in function.flow.calls):
                    return f"{function.name} gives several images one {_NAME}"
        return None

    def _is_used(self, function: Function, depth: int = 0) -> bool:
        """Whether something can lead to a function: not to what a fork has kept of the codebase that it is made of."""
        if function.owner is not None or function.parent is None or depth > _DEPTH:
            return True
        callers = [caller for caller in self.program.mentioning(function.name) if _calls(caller, function)]
        return any(self._is_used(caller, depth + 1) for caller in callers)

    def _of_scenes_in_turn(self, function: Function) -> Optional[str]:
        """Why a name may be of several pictures: one run goes through several scenes, ``args.source_path = folder``."""
        for module in self.program.matching(_PLACED):
            for other in module.scopes(_PLACED.search):
                definitions = [d for found in other.flow.definitions.values() for d in found]
                placed = [d for d in definitions if d.place.endswith(".source_path") and _changes(other, d)]
                if placed and module.path in self.program.together(function.module):
                    return f"{other.name or module.path} reads several scenes, where names come again"
        return None

    def _remade(self, function: Function, holder: cst.Name, attribute: str) -> Optional[str]:
        """Why the camera may be another than the one that has the name: ``view = scaled(camera, 0.5)``."""
        for definition in function.flow.reaching(holder):
            made = definition.value if definition.kind == "assign" else None
            for reference in self.program.resolve(function, made.func) if isinstance(made, cst.Call) else ():
                maker = reference.target
                if isinstance(maker, Function) and re.search(rf"\.{attribute}\s*=[^=]", code(maker.body)):
                    return f"{maker.name} gives it another {attribute}"
        return None

    def _reads_twice(self) -> bool:
        """Whether a reader makes cameras of the same poses a second time, with the pictures of another folder."""
        for module in self.program.matching(_POSES):
            for function in module.scopes(_POSES.search):
                read = [(call_name(call), arguments(call)[1].get("cam_extrinsics")) for call in function.flow.calls]
                given = [(name, code(poses)) for name, poses in read if poses is not None]
                if len(given) != len(set(given)):
                    return True
        return False

    def _nameless(self, function: Function, node: cst.CSTNode, seen: Set[int]) -> Optional[str]:
        """Why the camera may have no name: one whose class stores none is added, ``stack.append(view)``."""
        for definition in function.flow.reaching(node):
            value = definition.value
            if value is None or id(definition) in seen:
                continue
            seen.add(id(definition))
            if definition.kind == "mutate" and isinstance(value, cst.Call):
                for given in arguments(value)[0]:
                    for reference in self.program.resolve(function, given):
                        made = reference.target
                        if reference.kind != "instance" or not isinstance(made, Class):
                            continue
                        if not any(each.stores(_NAME) for each in (made, *self.program.bases(made))):
                            return f"{definition.place} also holds {made.name}s, which have no {_NAME}"
                continue
            chain = list(attribute_chain(value))
            asked = [part.attr.value for part in chain if isinstance(part, cst.Attribute)]
            if not set(asked) <= _OF_LISTS:  # scenes[0].getTrainCameras(): no more of that list
                others = [name for name in asked if _OTHER_CAMERAS.match(name)]
                if others and self._reads_twice():
                    return f"{others[0]} gives cameras with the names of others"
                continue
            found = self._nameless(function, chain[-1], seen)
            if found is not None:
                return found
        return None


def _calls(caller: Function, function: Function) -> bool:
    """Whether it calls a function of this name, or hands it on."""
    if caller is function:
        return False
    read = [part.value for part in caller.flow.reads]
    return function.name in read or any(call_name(call) == function.name for call in caller.flow.calls)


def _of_no_photograph(function: Function, site: cst.CSTNode) -> Optional[str]:
    """Why the cameras have none here: ``if camera.is_virtual:``."""
    for name in function.flow.conditions.get(id(site), ()):
        if _NO_PHOTOGRAPHS & set(words(name)):
            return f"only where {name}"
    return None


def _of_several(function: Function, node: cst.CSTNode, seen: Set[int]) -> Optional[str]:
    """Why names may come again: ``for scene in scenes: ... scene.getTrainCameras()``."""
    for definition in function.flow.reaching(node):
        if definition.value is None or id(definition) in seen:
            continue
        seen.add(id(definition))
        root = list(attribute_chain(definition.value))[-1]
        scenes = function.flow.reaching(root) if "getTrainCameras" in code(definition.value) else ()
        if any(_is_turn(function, scene) for scene in scenes):
            return f"{code(root)} is one of several, where names come again"
        found = _of_several(function, root, seen)
        if found is not None:
            return found
    return None


def _is_turn(function: Function, definition: Definition) -> bool:
    """Whether a name is what a loop goes over, or a part of that."""
    loops = [loop for loop in loops_around(function.body, definition.node) if isinstance(loop, cst.For)]
    return any(definition.node is part for loop in loops for part in walk_expressions(loop.target))


def _told_apart(function: Function, holder: str) -> Optional[str]:
    """Why a name alone may be of several pictures: ``masks[time, camera.image_name]`` asks for more."""
    for node in walk_expressions(function.body):
        if isinstance(node, cst.Subscript):
            keys = [part.slice.value for part in node.slice if isinstance(part.slice, cst.Index)]
            if len(keys) == 1 and isinstance(keys[0], cst.Tuple):
                keys = [element.value for element in keys[0].elements]
            if len(keys) > 1 and any(dotted(key) == f"{holder}.{_NAME}" for key in keys):
                return f"{_short(node)} asks for more than the name"
    return None


def _changes(function: Function, definition: Definition) -> bool:
    """Whether a value is another at each turn of a loop, or for each item of a dataset."""
    loops = [loop for loop in loops_around(function.body, definition.node) if isinstance(loop, cst.For)]
    turns = {part.value for loop in loops for part in walk_expressions(loop.target) if isinstance(part, cst.Name)}
    turns |= set(function.parameters) if function.name == "__getitem__" else set()
    return definition.value is not None and function.depends(definition.value, turns)


def _names_again(function: Function, call: cst.Call) -> bool:
    """``for frame in frames: ... CameraInfo(image=image, image_name=image_name)``, where the name is the camera's.

    The image depends on what the innermost loop goes over, the name does not.
    """
    keywords = arguments(call)[1]
    loops = loops_around(function.body, call)
    if not loops or not isinstance(loops[0], cst.For) or not {"image", _NAME} <= set(keywords):
        return False
    turns = {name.value for name in walk_expressions(loops[0].target) if isinstance(name, cst.Name)}
    return function.depends(keywords["image"], turns) and not function.depends(keywords[_NAME], turns)


def _overwritten(function: Function, holder: str, attribute: str) -> Optional[str]:
    """Why the image may be another by then: it is written here, or the file puts others in their places."""
    for definition in function.flow.definitions.get(f"{holder}.{attribute}", []):
        return f"{holder}.{attribute} is written here: {_short(definition.node)}"
    for scope in function.module.scopes(re.compile(rf"\.{attribute}\s*=[^=]").search):
        for place, definitions in scope.flow.definitions.items():
            if place.endswith(f".{attribute}") and not place.startswith("self."):
                for definition in definitions:
                    if definition.value is not None and not _of_same(definition.value, attribute):
                        return f"{place} is written in this file: {_short(definition.node)}"
    return None


def _of_same(value: cst.CSTNode, attribute: str) -> bool:
    """``None``, or what was stored before: ``camera.original_image_backup.cuda()``."""
    parts = attribute_chain(value)
    stored = any(isinstance(part, cst.Attribute) and part.attr.value.startswith(attribute) for part in parts)
    return stored or constant(value, value) is None


def _is_no_name(node: cst.CSTNode) -> bool:
    """``image_name=info.image_path``, or the same for all: ``image_name=None``."""
    path = dotted(node) is not None and "path" in words(code(node).split(".")[-1])
    return path or constant(node, node) is not node


def _unit_range(node: cst.Call, skip: int) -> bool:
    positional, keywords, starred = arguments(node)
    bounds = [constant(value) for value in positional[skip:]]
    bounds += [constant(keywords[key]) for key in ("min", "max") if key in keywords]
    return not starred and len(bounds) == 2 and bounds[0] == 0 and bounds[1] == 1


def _first_channels(node: cst.Subscript) -> bool:
    """``[:3]``, ``[0:3, :, :]``, ``[:3, ...]``: the colour channels of a channels-first image, all of its pixels."""
    for i, element in enumerate(node.slice):
        part = element.slice
        if isinstance(part, cst.Index):
            if not isinstance(part.value, cst.Ellipsis):
                return False
            continue
        assert isinstance(part, cst.Slice)
        lower, upper = constant(part.lower, None), constant(part.upper, None)
        if part.step is not None or (lower not in (None, 0)) or (part.lower is not None and lower is None):
            return False
        if i == 0:
            if upper != 3 and part.upper is not None:
                return False
        elif part.upper is not None:
            return False
    return True


def _short(node: cst.CSTNode) -> str:
    text = " ".join(code(node).split())
    return text if len(text) <= 60 else text[:57] + "..."
