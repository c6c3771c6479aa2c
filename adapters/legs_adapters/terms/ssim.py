"""Find whether an SSIM is computed of the same two expressions: they are images then, whatever their names."""

from __future__ import annotations

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import attribute_chain, call_name, same
from legs_adapters.lexicon.words import STRUCTURAL

__all__ = ["is_beside_ssim", "is_given"]


def is_beside_ssim(function: Function, first: cst.CSTNode, second: cst.CSTNode) -> bool:
    """Return whether an SSIM is computed of the same two expressions: they are images then."""
    structural = [call for call in function.flow.calls if STRUCTURAL.search(call_name(call))]
    return any(is_given(function, call, first) and is_given(function, call, second) for call in structural)


def is_given(function: Function, call: cst.Call, picture: cst.CSTNode) -> bool:
    """Return whether an image, or one with another axis, ``image.unsqueeze(0)``, is an argument of a call."""
    parts = [part for arg in call.args for part in attribute_chain(arg.value)]
    return any(same(part, picture) for part in parts) and function.flow.unchanged_at(call, picture)
