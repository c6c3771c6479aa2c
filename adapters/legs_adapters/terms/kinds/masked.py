"""``image = legs_loss.masked(image, gt_image)``: the line that hides masked pixels from every term of a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, List, Optional

import libcst as cst

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

    after: Optional[cst.CSTNode] = None
    before: Optional[cst.CSTNode] = None

    term: ClassVar[str] = "mask"
    done: ClassVar[str] = "is masked, in every term that gets the rendering,"

    @property
    def line(self) -> str:
        """The line, for the edit and for advice."""
        rendering, photograph = (on_one_line(code(side)) for side in (self.first, self.second))
        return f"{rendering} = {PACKAGE}.masked({rendering}, {photograph})"

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Write the line; where lines have to keep their numbers, before or after a statement beside it, if one can."""
        assert self.before is not None
        line = self.line
        if writing.in_place and isinstance(self.before, cst.SimpleStatementLine):
            at = text.span(self.before)[0]
            return [text.replace(at, at, f"{line}; ")]
        if writing.in_place and isinstance(self.after, cst.SimpleStatementLine):
            end = text.span(self.after.body[-1])[1]
            return [text.replace(end, end, f"; {line}")]
        lines, beside = text.module.lines, text.function.place(self.after or self.before)
        at = lines.start(beside.last_line + 1 if self.after is not None else beside.line)
        indentation = text.between(lines.start(beside.line), beside.start)
        newline = "\r\n" if text.bytes[:at].endswith(b"\r\n") else "\n"
        return [text.replace(at, at, indentation + line + newline)]
