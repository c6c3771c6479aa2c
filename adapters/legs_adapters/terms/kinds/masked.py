"""``image = legs_loss.masked(image, gt_image)``: the line that hides masked pixels from every term of a step."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from typing import ClassVar, List, Optional

from legs_adapters.code.module import blocks_of
from legs_adapters.code.syntax import code
from legs_adapters.terms.form import Form
from legs_adapters.terms.text import Edit, Text, on_one_line
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class Masked(Form):
    """A line of its own between two statements of one block; only legs-patch --masks writes it.

    Attributes:
        after: the statement before the line; None where the block begins with it.
        before: the statement after the line.

    Examples:
        before: gt_image = cam.original_image; loss = l1_loss(image, gt_image)
        after: image = legs_loss.masked(image, gt_image)
    """

    after: Optional[ast.AST] = None
    before: Optional[ast.AST] = None

    term: ClassVar[str] = "mask"
    done: ClassVar[str] = "is masked, in every term that gets the rendering,"

    @property
    def line(self) -> str:
        """The line, for the edit and for advice."""
        rendering, photograph = (on_one_line(code(side, True)) for side in (self.first, self.second))
        return f"{rendering} = {PACKAGE}.masked({rendering}, {photograph})"

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Write the line; where lines have to keep their numbers, before or after a statement beside it, if one can."""
        assert self.before is not None
        line = self.line
        if writing.in_place and not any(blocks_of(self.before)):
            at = text.span(self.before)[0]
            return [text.replace(at, at, f"{line}; ")]
        if writing.in_place and self.after is not None and not any(blocks_of(self.after)):
            end = text.span(self.after)[1]
            return [text.replace(end, end, f"; {line}")]
        lines, before = text.module.lines, text.function.place(self.before)
        above = text.function.place(self.after).last_line + 1 if self.after is not None else before.line
        at, indentation = lines.start(above), text.between(lines.start(before.line), before.start)
        newline = "\r\n" if text.bytes[:at].endswith(b"\r\n") else "\n"
        return [text.replace(at, at, indentation + line + newline)]
