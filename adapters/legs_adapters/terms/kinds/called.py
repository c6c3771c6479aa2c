"""``F.l1_loss(a, b)``, or a call of the codebase's own L1 function."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import List, Optional, Tuple

import libcst as cst

from legs_adapters.code.calls import given_to
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program, Reference
from legs_adapters.code.syntax import arguments, call_name, code, constant, words
from legs_adapters.lexicon.names import TORCH_L1, is_l1_name
from legs_adapters.lexicon.words import PERCEPTUAL
from legs_adapters.terms.form import Form
from legs_adapters.terms.functions import L1Functions
from legs_adapters.terms.text import Edit, Text, residue
from legs_adapters.terms.writing import Writing
from legs_loss import LegsError

__all__ = ["Called"]


@dataclass(frozen=True)
class Called(Form):
    """A call of an L1 function with two images.

    Example:
        before: loss = l1_loss(image, gt_image)
        after: loss = legs_loss.l1_loss(image, gt_image)
    """

    order = 50

    @classmethod
    def find(cls, functions: L1Functions, function: Function, call: cst.Call) -> Optional[Form]:
        """Find a call of an L1 function, by the function's body, or by its name where the body is not available."""
        if len(call.args) < 2:
            return None
        references = functions.program.resolve(function, call.func)
        if any(
            reference.kind == "external" and str(reference.target).startswith("legs_loss.") for reference in references
        ):
            return None  # patched before
        name = call_name(call)
        if any(reference.guess for reference in references) and not is_l1_name(name):
            return None  # a method of an object of unknown class: its name alone proves nothing
        if PERCEPTUAL & set(words(code(call.func))):
            return None  # lpips_model.forward(image, gt)
        references = references or _handed_on(functions.program, function, call)
        if not references:
            if not is_l1_name(name):
                return None
            pair = _pair(call, None)
            return None if pair is None else cls(call, call, pair[0], pair[1], call.func, pair[2])
        shapes = [functions.shape_of_reference(reference, call) for reference in references]
        if None in shapes:
            return None
        names = next((r.target.parameters for r in references if isinstance(r.target, Function)), None)
        pair = _pair(call, names)
        if pair is None:
            return None
        first, second, extras = pair
        makes = shapes[0] if len(set(shapes)) == 1 else "own"
        assert makes is not None
        if all(r.kind == "external" and TORCH_L1.search(str(r.target)) for r in references):
            keywords = {arg.keyword.value: constant(arg.value) for arg in extras if arg.keyword is not None}
            if keywords == {"reduction": "none"} and len(extras) == 1:
                makes, extras = "none", ()
            elif keywords == {"reduction": "mean"} and len(extras) == 1:
                extras = ()
        elif makes in ("mean", "none") and extras:
            # The arguments that settled the shape; the call no longer needs them.
            extras = ()
        return cls(call, call, first, second, call.func, tuple(extras), makes=makes)

    @property
    def takes_index(self) -> bool:
        """Return whether nothing but a mean is taken after the pixel by pixel difference."""
        assert self.callee is not None
        torchs = re.search(r"(^|\.)(F|functional)\.l1_loss$", code(self.callee))
        return self.makes != "own" or (torchs is not None and not self.extras)

    def _own(self, writing: Writing) -> str:
        assert self.callee is not None
        return "" if self.takes_index else writing.own(self.callee, self.extras)

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Replace the function, order the two images, and replace the further arguments by the settings."""
        taken = [arg for arg in self.call.args if arg.value is self.first or arg.value is self.second]
        edits = [text.replace(*text.span(self.call.func, True), f"{writing.package}.l1_loss")]
        sides = writing.ordered(*(text.argument(arg.value, writing.selection) for arg in taken))
        for arg, side, keyword in zip(taken, sides, ("prediction", "target")):
            edits.append(text.replace(*text.span(arg), side if arg.keyword is None else f"{keyword}={side}"))
        own, tail = "", ""
        if self.makes == "own":
            assert self.callee is not None
            own = writing.own(self.callee, self.extras)
        elif writing.selection:
            tail = writing.selection + (".mean()" if self.is_mean else "")
        settings = writing.settings(self.is_map or bool(tail), own)
        after, end, kept = text.span(taken[-1])[1], text.span(taken[-1])[1], ""
        dropped = [text.span(arg) for arg in self.call.args if arg not in taken]
        if dropped:
            if min(dropped)[0] < after:
                raise LegsError(
                    f"{writing.where}: the images are not the first two arguments: "
                    f"write {writing.package}.l1_loss(...) there by hand"
                )
            end = max(last for _, last in dropped)
            kept = residue(text.between(after, end))
        if settings or kept or end != after:
            edits.append(text.replace(after, end, settings + kept))
        if tail:
            end = text.span(self.call)[1]
            edits.append(text.replace(end, end, tail))
        return edits


def _handed_on(program: Program, function: Function, node: cst.Call) -> List[Reference]:
    """Return torch's L1 for a parameter ``loss_fn``, where every caller passes that."""
    name = call_name(node)
    if not function.is_parameter(node.func) or arguments(node)[2]:
        return []
    if not function.name or function.runs_by_instance:
        return []
    found: List[Reference] = []
    for caller, value in given_to(program, function, name):
        references = program.resolve(caller, value) if value is not None else []
        if not references or not all(r.kind == "external" and TORCH_L1.search(str(r.target)) for r in references):
            return []
        found += references
    return found


def _pair(
    node: cst.Call, names: Optional[List[str]]
) -> Optional[Tuple[cst.BaseExpression, cst.BaseExpression, Tuple[cst.Arg, ...]]]:
    """Return the two arguments that are compared, and the others."""
    positional, keywords, starred = arguments(node)
    if starred:
        return None
    if len(positional) >= 2:
        taken: List[cst.BaseExpression] = positional[:2]
    else:
        known = [names[:2]] if names else []
        known += [
            ["input", "target"],
            ["prediction", "target"],
            ["network_output", "gt"],
            ["pred", "gt"],
            ["pred", "target"],
        ]
        taken = []
        for pair in known:
            if len(pair) == 2:
                values = [*positional, *(keywords[key] for key in pair[len(positional) :] if key in keywords)]
                if len(values) == 2:
                    taken = values
                    break
        if not taken:
            return None
    extras = tuple(arg for arg in node.args if not any(arg.value is value for value in taken))
    return taken[0], taken[1], extras
