"""Decide whether a target is a view's stored image, unchanged between loading and loss: only then ``view=`` is passed.

The proof needs three facts: the target is ``camera.original_image`` (or what the codebase calls it), moved between
devices and types but not changed; ``camera`` is the same view where the name is asked; and its name is that image's.
"""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Set, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.reaching import Definition
from legs_adapters.code.syntax import arguments, brief, call_name, code, constant, dotted, words
from legs_adapters.lexicon.view_names import NAME, Names
from legs_adapters.lexicon.words import RESIZING, SHIFTING, STORED_IMAGES
from legs_adapters.tensors.operations import JOINS, MOVES

__all__ = ["View", "Views"]


class View(NamedTuple):
    """The verdict: the text to pass as ``view=``, or None; and the reason, in words."""

    text: Optional[str]
    reason: str


class Views:
    """Verdicts for one program."""

    def __init__(self, program: Program) -> None:
        self.names: Names = Names(program)

    def of(self, function: Function, target: cst.CSTNode, site: cst.CSTNode) -> View:
        """Return the verdict for the target of one call site."""
        images: List[Tuple[cst.Attribute, Function]] = []
        problem = self._trace(function, target, images, set())
        if problem is not None:
            return View(None, problem)
        if not images:
            return View(None, "not a view's stored image")
        if len({(code(image), where) for image, where in images}) != 1:
            return View(None, "has several sources")
        image, where = images[0]
        holder = image.value
        if where is not function or not isinstance(holder, cst.Name):
            return View(None, f"{code(image)} has no name at the call site")
        unstored = self.names.unstored(image.attr.value)
        if unstored is not None:
            return View(None, unstored)
        then = function.flow.reaching(holder)
        if not then or function.flow.names_at(site, holder.value) != then:
            return View(None, f"{holder.value} may be another view at the call site")
        doubt = self.names.doubt(function, holder, image.attr.value, site)
        if doubt is not None:
            return View(None, doubt)
        return View(f"{holder.value}.{NAME}", f"{code(image)}, untouched")

    def _trace(
        self, function: Function, node: cst.CSTNode, images: List[Tuple[cst.Attribute, Function]], seen: Set[int]
    ) -> Optional[str]:
        """Follow the target to where it is stored; return why that fails, if it does."""
        if (
            isinstance(node, cst.Attribute)
            and node.attr.value in STORED_IMAGES
            and dotted(node.value) not in (None, "self")
        ):
            images.append((node, function))
            return None
        if isinstance(node, cst.Name):
            definitions = function.flow.reaching(node)
            if not definitions:
                return f"{node.value} is not assigned in this function"
            for definition in sorted(definitions, key=lambda d: d.order):
                problem = self._definition(function, definition, images, seen)
                if problem is not None:
                    return problem
            return None
        if isinstance(node, cst.Call) and isinstance(node.func, cst.Attribute):
            name = node.func.attr.value
            if name in MOVES:
                return self._trace(function, node.func.value, images, seen)
            if name in ("clamp", "clip") and _unit_range(node, 0):
                return self._trace(function, node.func.value, images, seen)
            if dotted(node.func) in ("torch.clamp", "torch.clip") and node.args and _unit_range(node, 1):
                return self._trace(function, node.args[0].value, images, seen)
            if name in JOINS:
                return "batched"
        if isinstance(node, cst.Subscript):
            if _first_channels(node):
                return self._trace(function, node.value, images, seen)
            if isinstance(node.slice[0].slice, cst.Index) and isinstance(constant(node.slice[0].slice.value), str):
                return f"{brief(node)} has no view name"
            return self._trace(function, node.value, images, seen) or f"indexed: {brief(node)}"
        if isinstance(node, cst.Call):
            name = call_name(node)
            spoken = set(words(name))
            if spoken & RESIZING:
                return f"resized by {name}"
            if spoken & SHIFTING:
                return f"shifted by {name}"
            return f"changed by {name or 'a call'}"
        if isinstance(node, cst.BinaryOperation):
            if isinstance(node.operator, (cst.Divide, cst.Multiply)) and constant(node.right) is not None:
                return f"scaled: {brief(node)}"
            return f"composited: {brief(node)}"
        if isinstance(node, cst.IfExp):
            return self._trace(function, node.body, images, seen) or self._trace(function, node.orelse, images, seen)
        return f"not traced: {brief(node)}"

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
            return f"changed in place: {brief(definition.node)}"
        return f"{definition.place} comes from a batch"


def _unit_range(node: cst.Call, skip: int) -> bool:
    positional, keywords, starred = arguments(node)
    bounds = [constant(value) for value in positional[skip:]]
    bounds += [constant(keywords[key]) for key in ("min", "max") if key in keywords]
    return not starred and len(bounds) == 2 and bounds[0] == 0 and bounds[1] == 1


def _first_channels(node: cst.Subscript) -> bool:
    """Return whether an index keeps all pixels of the colour channels: ``[:3]``, ``[0:3, :, :]``, ``[:3, ...]``."""
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
