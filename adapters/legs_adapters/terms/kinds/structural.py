"""``ssim(image, gt)``: the structural term, computed by ``legs_loss.ssim`` with the same value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, List, Optional, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import arguments, call_name, constant
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.ssim import STRUCTURAL
from legs_adapters.terms.text import Edit, Text, on_one_line, residue
from legs_adapters.terms.writing import Writing

__all__ = ["Structural"]

_MISSING = object()
_KEYWORDS = (["img1", "img2"], ["prediction", "target"], ["pred", "target"], ["image", "gt"])


@dataclass(frozen=True)
class Structural(Form):
    """A call of an SSIM with two images; only legs-patch --ssim looks for it.

    Example:
        before: loss = l1_loss(image, gt_image) + 1.0 - ssim(image, gt_image)
        after: 1.0 - legs_loss.ssim(image, gt_image)
    """

    weighs: ClassVar[bool] = False
    term: ClassVar[str] = "ssim"
    done: ClassVar[str] = "is computed by legs_loss.ssim"

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find a call of a function that is named as an SSIM; what it computes is checked later."""
        inner = call_name(call.func) if isinstance(call.func, cst.Call) else ""  # SSIM()(image, gt)
        if not STRUCTURAL.search(call_name(call) or inner):
            return None
        references = functions.program.resolve(function, call.func)
        if any(r.kind == "external" and str(r.target).startswith("legs_loss.") for r in references):
            return None  # patched before
        names = [r.target.parameters[:2] for r in references if isinstance(r.target, Function)]
        sides = _sides(call, [*names, *_KEYWORDS])
        if sides is None:
            return None
        extras = tuple(arg for arg in call.args if not any(arg.value is side for side in sides))
        return cls(call, call, *sides, call.func, extras)

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace the function; the further arguments are the defaults of ``legs_loss.ssim``, and are dropped."""
        edits = [text.replace(*text.span(self.call.func, True), f"{writing.package}.ssim")]
        if self.extras or any(arg.keyword is not None for arg in self.call.args):
            start, end = text.span(self.call.args[0])[0], text.span(self.call.args[-1])[1]
            sides = ", ".join(on_one_line(text.of(side, True)) for side in (self.first, self.second))
            edits.append(text.replace(start, end, sides + residue(text.between(start, end))))
        return edits

    def _advice(self, writing: Writing, prediction: str, target: str, rows: bool) -> str:
        return f"{writing.package}.ssim({prediction}, {target})"


def _sides(call: cst.Call, named: List[List[str]]) -> Optional[Tuple[cst.BaseExpression, cst.BaseExpression]]:
    """Return the two images; None where there are not two."""
    positional, keywords, starred = arguments(call)
    pairs = [[*positional, *(keywords[name] for name in pair[len(positional) :] if name in keywords)] for pair in named]
    pair = positional[:2] if len(positional) >= 2 else next((found for found in pairs if len(found) == 2), [])
    if starred or len(pair) != 2 or any(constant(side, _MISSING) is not _MISSING for side in pair):
        return None
    return pair[0], pair[1]
