"""``error = abs(a - b)``, of which one read is the loss and others are not: only that read is replaced."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List

from legs_adapters.terms.form import Form
from legs_adapters.terms.text import Edit, Text, on_one_line
from legs_adapters.terms.writing import PACKAGE, Writing


@dataclass(frozen=True)
class Reread(Form):
    """The read of an error map that is the loss; ``node`` is that read.

    Examples:
        before: error = torch.abs(image - gt_image); seen = error.detach() > 0.1; loss = error.mean(); log(seen)
        after: loss = legs_loss.l1_loss(image, gt_image, reduction="none").mean(); log(seen)
    """

    def edits(self, text: Text, writing: Writing) -> List[Edit]:
        """Write the weighted map in the read's place."""
        sides = (on_one_line(text.argument(side, writing.selection)) for side in (self.first, self.second))
        arguments = f"{', '.join(writing.ordered(*sides))}{writing.settings(as_map=True)}"
        return [text.replace(*text.span(self.node), f"{PACKAGE}.l1_loss({arguments}){writing.selection}")]
