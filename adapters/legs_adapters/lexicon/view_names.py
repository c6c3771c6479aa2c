"""Decide whether a camera's name identifies one photograph: only then it is passed as ``view=``.

The camera's class has to store a name, and the readers have to give each image its own; nothing may assign another
image to a camera, or copy a camera; and one run may not go through several scenes.
"""

from __future__ import annotations

import re
from typing import List, Optional, Set

import libcst as cst

from legs_adapters.code.module import Class, Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import (
    arguments,
    attribute_chain,
    brief,
    call_name,
    code,
    constant,
    dotted,
    loops_around,
    walk_expressions,
    words,
)
from legs_adapters.lexicon.words import NO_PHOTOGRAPHS
from legs_adapters.tensors.operations import depends

__all__ = ["NAME", "Names"]

NAME = "image_name"

_DEPTH = 4
_NAMING = re.compile(rf"\b{NAME}\s*=(?!=)")
_OF_LISTS = {"copy", "pop", "popleft"}
_OTHER_CAMERAS = re.compile(r"get(?!Train|Test)\w+Cam(era)?s$")
_POSES = re.compile(r"\bcam_extrinsics\s*=")
_PLACED = re.compile(r"\.source_path\s*=[^=]")  # in the settings that Inria's Scene reads


class Names:
    """Answer for one program."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self._cameras: Optional[List[Class]] = None

    def doubt(self, function: Function, camera: cst.Name, attribute: str, site: cst.CSTNode) -> Optional[str]:
        """Return why ``camera.image_name`` may not be the name of ``camera.original_image`` alone; None where it is."""
        return (
            _overwritten(function, camera.value, attribute)
            or self._nameless(function, camera, set())
            or self._remade(function, camera, attribute)
            or _of_several(function, camera, set())
            or _of_no_photograph(function, site)
            or _told_apart(function, camera.value)
            or self._of_scenes_in_turn(function)
        )

    def unstored(self, attribute: str) -> Optional[str]:
        """Return why no camera class stores this attribute and a name; None where one does."""
        if self._cameras is None:
            self._cameras = []
            for module in self.program.matching(re.compile(r"self\.image_name\s*=")):
                self._cameras.extend(c for c in module.classes if c.stores(NAME))
        if not self._cameras:
            return f"no class of this codebase stores {NAME}"
        if not any(camera.stores(attribute) or attribute in camera.methods for camera in self._cameras):
            return f"no class of this codebase stores both {attribute} and {NAME}"
        for camera in self._cameras:
            if attribute in camera.methods and "property" in camera.methods[attribute].decorators:
                return f"{attribute} is recomputed at each access"
            for method, _ in camera.stores(NAME):
                renames = method.name != "__init__" and NAME in method.parameters
                if renames and self.program.mentioning(method.name, called=True):
                    return f"{method.name} changes the {NAME} of a camera"
        return self._named()

    def _named(self) -> Optional[str]:
        """Return why the name of the cameras is not a photograph's, if it is not at any place that makes them."""
        makers = [
            (function, keywords[NAME])
            for name in {camera.name for camera in self._cameras or ()}
            for function in self.program.mentioning(name, called=True)
            for call in function.flow.calls
            if call_name(call) == name
            for keywords in (arguments(call)[1],)
            if NAME in keywords
        ]
        given = [value for function, value in makers if self._is_used(function)] or [value for _, value in makers]
        if given and all(_is_no_name(value) for value in given):
            return f"{NAME} is {brief(given[0])}"
        for module in self.program.matching(_NAMING):
            for function in module.scopes(_NAMING.search):
                if self._is_used(function) and any(_names_again(function, call) for call in function.flow.calls):
                    return f"{function.name} gives several images the same {NAME}"
        return None

    def _is_used(self, function: Function, depth: int = 0) -> bool:
        """Return whether a function may be called; forks keep functions that are dead code."""
        if function.owner is not None or function.parent is None or depth > _DEPTH:
            return True
        callers = [caller for caller in self.program.mentioning(function.name) if _calls(caller, function)]
        return any(self._is_used(caller, depth + 1) for caller in callers)

    def _of_scenes_in_turn(self, function: Function) -> Optional[str]:
        """Return why a name may be of several images: one run reads several scenes, ``args.source_path = folder``."""
        for module in self.program.matching(_PLACED):
            for other in module.scopes(_PLACED.search):
                placed = [
                    d for d in other.flow.every_definition if d.place.endswith(".source_path") and _changes(other, d)
                ]
                if placed and module.path in self.program.together(function.module):
                    return f"{other.name or module.path} reads several scenes, whose names may repeat"
        return None

    def _remade(self, function: Function, holder: cst.Name, attribute: str) -> Optional[str]:
        """Return why the camera may be a changed copy: ``view = scaled(camera, 0.5)``."""
        for definition in function.flow.reaching(holder):
            made = definition.value if definition.kind == "assign" else None
            for reference in self.program.resolve(function, made.func) if isinstance(made, cst.Call) else ():
                maker = reference.target
                if isinstance(maker, Function) and re.search(rf"\.{attribute}\s*=[^=]", code(maker.body)):
                    return f"{maker.name} changes its {attribute}"
        return None

    def _reads_twice(self) -> bool:
        """Return whether a reader makes a second camera for each pose, with the images of another folder."""
        for module in self.program.matching(_POSES):
            for function in module.scopes(_POSES.search):
                read = [(call_name(call), arguments(call)[1].get("cam_extrinsics")) for call in function.flow.calls]
                given = [(name, code(poses)) for name, poses in read if poses is not None]
                if len(given) != len(set(given)):
                    return True
        return False

    def _nameless(self, function: Function, node: cst.CSTNode, seen: Set[int]) -> Optional[str]:
        """Return why the camera may have no name: one whose class stores none is added, ``stack.append(view)``."""
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
                        if not any(each.stores(NAME) for each in (made, *self.program.bases(made))):
                            return f"{definition.place} also holds {made.name}s, which have no {NAME}"
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
    """Return whether it calls a function of this name, or passes it on."""
    if caller is function:
        return False
    read = [part.value for part in caller.flow.reads]
    return function.name in read or any(call_name(call) == function.name for call in caller.flow.calls)


def _of_no_photograph(function: Function, site: cst.CSTNode) -> Optional[str]:
    """Return the condition under which the cameras have no photograph: ``if camera.is_virtual:``."""
    for name in function.flow.conditions.get(id(site), ()):
        if NO_PHOTOGRAPHS & set(words(name)):
            return f"only if {name}"
    return None


def _of_several(function: Function, node: cst.CSTNode, seen: Set[int]) -> Optional[str]:
    """Return why names may repeat: ``for scene in scenes: ... scene.getTrainCameras()``."""
    for definition in function.flow.reaching(node):
        if definition.value is None or id(definition) in seen:
            continue
        seen.add(id(definition))
        root = list(attribute_chain(definition.value))[-1]
        scenes = function.flow.reaching(root) if "getTrainCameras" in code(definition.value) else ()
        if any(_is_turn(function, scene) for scene in scenes):
            return f"{code(root)} is one of several, whose names may repeat"
        found = _of_several(function, root, seen)
        if found is not None:
            return found
    return None


def _is_turn(function: Function, definition: Definition) -> bool:
    """Return whether a name is a loop's target, or a part of it."""
    loops = [loop for loop in loops_around(function.body, definition.node) if isinstance(loop, cst.For)]
    return any(definition.node is part for loop in loops for part in walk_expressions(loop.target))


def _told_apart(function: Function, holder: str) -> Optional[str]:
    """Return why a name may be of several images: ``masks[time, camera.image_name]`` uses more than the name."""
    for node in walk_expressions(function.body):
        if isinstance(node, cst.Subscript):
            keys = [part.slice.value for part in node.slice if isinstance(part.slice, cst.Index)]
            if len(keys) == 1 and isinstance(keys[0], cst.Tuple):
                keys = [element.value for element in keys[0].elements]
            if len(keys) > 1 and any(dotted(key) == f"{holder}.{NAME}" for key in keys):
                return f"{brief(node)} needs more than the name"
    return None


def _changes(function: Function, definition: Definition) -> bool:
    """Return whether a value changes with each iteration of a loop, or each item of a dataset."""
    loops = [loop for loop in loops_around(function.body, definition.node) if isinstance(loop, cst.For)]
    turns = {part.value for loop in loops for part in walk_expressions(loop.target) if isinstance(part, cst.Name)}
    turns |= set(function.parameters) if function.name == "__getitem__" else set()
    return definition.value is not None and depends(function, definition.value, turns)


def _names_again(function: Function, call: cst.Call) -> bool:
    """Return whether a camera is made for each frame with one name: ``CameraInfo(image=image, image_name=image_name)``.

    The image depends on the target of the innermost loop, the name does not.
    """
    keywords = arguments(call)[1]
    loops = loops_around(function.body, call) if {"image", NAME} <= set(keywords) else []
    if not loops or not isinstance(loops[0], cst.For):
        return False
    turns = {name.value for name in walk_expressions(loops[0].target) if isinstance(name, cst.Name)}
    return depends(function, keywords["image"], turns) and not depends(function, keywords[NAME], turns)


def _overwritten(function: Function, holder: str, attribute: str) -> Optional[str]:
    """Return why the image may have been replaced: it is assigned here, or elsewhere in the file."""
    for definition in function.flow.definitions.get(f"{holder}.{attribute}", []):
        return f"{holder}.{attribute} is assigned here: {brief(definition.node)}"
    for scope in function.module.scopes(re.compile(rf"\.{attribute}\s*=[^=]").search):
        for place, definitions in scope.flow.definitions.items():
            if place.endswith(f".{attribute}") and not place.startswith("self."):
                for definition in definitions:
                    if definition.value is not None and not _of_same(definition.value, attribute):
                        return f"{place} is assigned in this file: {brief(definition.node)}"
    return None


def _of_same(value: cst.CSTNode, attribute: str) -> bool:
    """Return whether a value is ``None``, or the stored image itself: ``camera.original_image_backup.cuda()``."""
    parts = attribute_chain(value)
    stored = any(isinstance(part, cst.Attribute) and part.attr.value.startswith(attribute) for part in parts)
    return stored or constant(value, value) is None


def _is_no_name(node: cst.CSTNode) -> bool:
    """Return whether a value does not name an image: ``info.image_path``, or a constant such as ``None``."""
    path = dotted(node) is not None and "path" in words(code(node).split(".")[-1])
    return path or constant(node, node) is not node
