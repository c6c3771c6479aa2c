"""``ssim(image, gt)``: the structural term, computed by ``legs_loss.ssim`` with the same value."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import ClassVar, List, Optional

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, constant, given
from legs_adapters.lexicon.words import STRUCTURAL
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, residue
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class Ssim(Form):
    """A call of an SSIM with two images; only legs-patch --ssim looks for it.

    Examples:
        before: loss = l1_loss(image, gt_image) + 1.0 - ssim(image, gt_image)
        after: 1.0 - legs_loss.ssim(image, gt_image)
    """

    term: ClassVar[str] = "ssim"
    done: ClassVar[str] = "is computed by legs_loss.ssim"

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: ast.Call) -> Optional[Ssim]:
        """Find a call of a function that is named as an SSIM; what it computes is checked later."""
        inner = call_name(call.func) if isinstance(call.func, ast.Call) else ""  # SSIM()(image, gt)
        if not STRUCTURAL.search(call_name(call) or inner):
            return None
        positional, _, starred = arguments(call)
        pair = [side for side in positional[:2] if constant(side) is None]
        references = functions.program.resolve(function, call.func)
        is_patched = any(r.kind == "external" and str(r.target).startswith("legs_loss.") for r in references)
        if is_patched or starred or len(pair) < 2:
            return None
        return cls(call, call, pair[0], pair[1], call.func, tuple(given(call)[2:]))

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace the function; the further arguments are the defaults of ``legs_loss.ssim``, and are dropped."""
        function, call = text.span(self.call.func), text.span(self.call)
        second, last = (text.argument_span(self.call, at)[1] for at in (1, -1))
        arguments = (
            text.between(function[1], second) + residue(text.between(second, last)) + text.between(last, call[1])
        )
        return [text.replace(function[0], call[1], f"{PACKAGE}.ssim{arguments}")]
