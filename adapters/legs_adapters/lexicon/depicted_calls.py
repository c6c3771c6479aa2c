"""Find what a call depicts: a rendering, a loaded photograph, or a function of an image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import arguments, call_name, constant, words
from legs_adapters.lexicon.holders import role_of_holder
from legs_adapters.lexicon.meaning import UNKNOWN, Meaning, mix
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.usage import draws, is_box
from legs_adapters.lexicon.words import LOADING, MATCHED, OF_DIFFUSION, RENDERERS, STATISTICS
from legs_adapters.tensors.operations import (
    EXTREMES,
    JOINS,
    MODULES,
    NUMBERS,
    PICTURE_FUNCTIONS,
    PICTURE_METHODS,
    REDUCES,
)

__all__ = ["meaning_of_call"]


if TYPE_CHECKING:
    from legs_adapters.lexicon.depiction import Meanings


def meaning_of_call(meanings: Meanings, function: Function, node: cst.Call, depth: int) -> Meaning:
    """Return what a call depicts, from its name, its arguments and the definition of the function."""
    name = call_name(node)
    positional, keywords, _ = arguments(node)
    values = [*positional, *keywords.values()]
    base = node.func.value if isinstance(node.func, cst.Attribute) else None
    module = isinstance(base, cst.Name) and (base.value in MODULES or _is_module(meanings.program, function, base))
    if name == "get" and positional and isinstance(constant(positional[0]), str) and base is not None:
        key = constant(positional[0])
        role = role_of_words(key) or role_of_holder(meanings, function, base, depth)
        return Meaning(kind_of_words(key), role)
    if "prompt" in keywords and OF_DIFFUSION & set(keywords):
        return Meaning("warp", None)
    if (base is None and name in NUMBERS) or (base is not None and name == "item"):
        return UNKNOWN
    if name in EXTREMES and (base is not None or positional):
        of, axes = (positional[0], positional[1:]) if module or base is None else (base, positional)
        meaning = meanings.of(function, of, depth)
        if meaning.kind == "image" and ("dim" in keywords or isinstance(constant(axes[0] if axes else None), int)):
            return meaning._replace(kind="parameter")  # the brightest channel of a photograph: a prior
        return meaning
    if name in REDUCES:
        axes = [
            *positional[1 if module or base is None else 0 :],
            *(keywords[k] for k in ("dim", "axis") if k in keywords),
        ]
        if all(isinstance(constant(axis), tuple) for axis in axes):
            return Meaning("parameter", None)  # a number of the whole image, or one a channel
    if name == "where" and len(values) == 3:
        return mix([meanings.of(function, value, depth) for value in values[1:]])
    if set(words(name)) & STATISTICS and not set(words(name)) & MATCHED and values:
        return Meaning("feature", meanings.of(function, values[0], depth).role)
    filters = name in ("conv2d", "filter2d", "spatial_gradient") and values and "stride" not in keywords
    if filters and not (len(positional) > 1 and is_box(function, positional[1])):
        return Meaning("gradient", meanings.of(function, values[0], depth).role)
    if name in JOINS and values:
        return meanings.of(function, values[0], depth)
    if base is not None and not module and name in PICTURE_METHODS:
        return meanings.of(function, base, depth)
    if (module or base is None) and name in PICTURE_FUNCTIONS and values:
        return meanings.of(function, values[0], depth)
    if base is not None and name in ("pop", "popleft", "__getitem__", "cuda"):
        return meanings.of(function, base, depth)
    spoken = set(words(name))
    kind = kind_of_words(name)
    if "compute" in spoken and kind is None:
        spoken = spoken - {"compute"}
    if spoken & RENDERERS or (kind is None and draws(values)):
        of_points = kind in (None, "parameter")  # points_to_render(...)
        return Meaning("image" if of_points else kind, "render")
    if kind is not None and kind not in ("image", "mask", "parameter"):
        return Meaning(kind, role_of_words(name))
    if kind == "image" and (role_of_words(name) == "target" or spoken & LOADING):
        holder = role_of_holder(meanings, function, base, depth) if base is not None else None
        return Meaning("image", role_of_words(name) or holder or "target")
    # A function of an image is an image, unless its name says otherwise: exposure, appearance, a background.
    parts = [meanings.of(function, value, depth) for value in values]
    images = [part for part in parts if part.kind == "image"]
    if images:
        return mix(images)
    if isinstance(node.func, cst.Call):  # Renderer(settings)(**means)
        return meanings.of(function, node.func, depth)
    if isinstance(node.func, (cst.Name, cst.Attribute)):
        made = _made_by(meanings, function, node.func, depth)
        if made is not None:
            return made
    if base is not None and not module:
        return Meaning(kind, meanings.of(function, base, depth).role if kind else None)
    return Meaning(kind, None)


def _is_module(program: Program, function: Function, node: cst.Name) -> bool:
    """Return whether a name is a module's, ``th`` of ``import torch as th``."""
    definitions = program.lookup(function, node)
    return bool(definitions) and all(isinstance(d.value, cst.Import) for _, d in definitions or ())


def _made_by(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int) -> Optional[Meaning]:
    """Return the meaning from the callee: an instance of a rasterizer, a function that returns images."""
    for reference in meanings.program.resolve(function, node):
        if reference.kind in ("instance", "class", "made by", "external", "function"):
            name = getattr(reference.target, "name", str(reference.target))
            if set(words(name)) & RENDERERS:
                return Meaning("image", "render")
        if reference.kind == "function" and isinstance(reference.target, Function) and not reference.guess:
            found = [meanings.of(reference.target, value, depth) for value in reference.target.flow.returns]
            if found and all(m.kind is not None or m.role is not None for m in found):
                return mix(found)
    return None
