"""Find what an expression depicts by the way it came alone: the renderer that draws it, the camera that holds it.

No name of a variable counts. What is not followed for certain is not known.
"""

from __future__ import annotations

import ast
from typing import AbstractSet, FrozenSet

from legs_adapters.code.module import Function
from legs_adapters.code.reaching import Definition, Reaching
from legs_adapters.code.syntax import attribute_chain, code, constant, indices, root_of, words, words_in
from legs_adapters.lexicon.calls import CallReading, meaning_of_call, meaning_returned
from legs_adapters.lexicon.depiction import Meanings
from legs_adapters.lexicon.meaning import UNKNOWN, Meaning
from legs_adapters.lexicon.names import kind_of_words, role_of_words
from legs_adapters.lexicon.words import BACKGROUND, DATA, GAUSSIANS, RENDERERS, SPLATS
from legs_adapters.tensors.operations import VIEWS

RENDERING = Meaning("image", "render")
PHOTOGRAPH = Meaning("image", "target")


class Ways(Meanings):
    """Answer for the expressions of one program as `Meanings` does, without the names of variables."""

    def _name(self, function: Function, node: ast.Name, flow: Meaning) -> Meaning:
        return flow

    def _of(self, function: Function, node: ast.AST) -> Meaning:
        if isinstance(node, ast.Call):
            call = CallReading(self.program, function, node, self.meaning)
            if RENDERERS & set(words(call.name)) and not self._draws_splats(function, node):
                return meaning_returned(call) or UNKNOWN
            if call.name == "grid_sample":
                return UNKNOWN  # one view warped into another, perhaps
            known = meaning_returned(call) or meaning_of_call(call, by_arguments=False)
            is_method = known == UNKNOWN and isinstance(node.func, ast.Attribute)
            return self._member(function, node.func, call.name) if is_method else known  # type: ignore[arg-type]
        known = super()._of(function, node)
        if isinstance(node, ast.BinOp) and not isinstance(node.op, (ast.Add, ast.Mult)):
            is_of_two = UNKNOWN not in (self.meaning(function, node.left), self.meaning(function, node.right))
            return UNKNOWN if is_of_two else known  # a difference of two pictures is none
        return known

    def _subscript(self, function: Function, node: ast.Subscript) -> Meaning:
        known = super()._subscript(function, node)
        return known if all(map(_keeps_colours, indices(node))) else known._replace(kind=None)

    def _member(self, function: Function, node: ast.Attribute | ast.Subscript, name: str) -> Meaning:
        kept = self._kept(function, node)
        if kept != UNKNOWN or name in VIEWS:
            return kept if kept != UNKNOWN else self.meaning(function, node.value)
        kind, says, role = kind_of_words(name), role_of_words(name), self.meaning(function, node.value).role
        if role is not None:  # a renderer may hand on what it was given
            is_other = says == "target" or BACKGROUND & set(words(name)) or self._holds_data(function, node.value)
            return Meaning(kind, None if is_other else role)
        is_photograph = kind == "image" and says != "render" and self._holds_data(function, node.value)
        return Meaning(kind, "target" if is_photograph else None)

    def _draws_splats(self, function: Function, call: ast.Call) -> bool:
        """Return whether a renderer is known to draw Gaussians: by what it is given, or where and how it is defined."""
        found = self.program.resolve(function, call.func)
        texts = [code(call), *(str(reference.target) for reference in found if isinstance(reference.target, str))]
        texts += [run.module.path + run.text for reference in found for run in self.program.run_by(reference)]
        return bool(GAUSSIANS & words_in(call)) or any(map(SPLATS.search, texts))

    def _holds_data(self, function: Function, node: ast.AST | Reaching) -> bool:
        """Return whether an object is a camera or a dataset's entry, by its name or those of what it is taken from.

        A camera of a view that was warped, or that nobody photographed, is none: ``pseudo_cam``.
        """
        return self.questions.answer(function, node, self._holds, False)

    def _holds(self, function: Function, node: ast.AST | Reaching) -> bool:
        if isinstance(node, Reaching):
            parts = [node.value] if isinstance(node, Definition) else node.parts
            return any(part is not None and self._holds_data(function, part) for part in parts)
        chain = list(attribute_chain(node))
        names = [root_of(part) for part in chain if isinstance(part, (ast.Name, ast.Attribute))]
        if "warp" in map(kind_of_words, names):
            return False
        if any(DATA & set(words(name)) for name in names):
            return "render" not in map(role_of_words, names)
        found = self.program.lookup(function, chain[-1])
        return found is not None and self._holds_data(*found)

    # -- definitions

    def _ways(self, function: Function, reaching: Reaching) -> FrozenSet[Meaning]:
        ways = super()._ways(function, reaching)
        return ways - {UNKNOWN} if isinstance(reaching, Definition) and reaching.kind == "store" else ways

    def _joined(self, ways: FrozenSet[Meaning]) -> Meaning:
        return _agreed(ways)

    def _parameter(self, function: Function, definition: Definition) -> Meaning:
        if definition.place not in function.parameters:
            return UNKNOWN
        given = self._given(function, definition.place)
        return _agreed({UNKNOWN if value is None else self.meaning(caller, value) for caller, _, value in given})


def _agreed(ways: AbstractSet[Meaning]) -> Meaning:
    return next(iter(ways)) if len(ways) == 1 else UNKNOWN


def _keeps_colours(index: ast.expr) -> bool:
    """Return whether an index leaves an image what it is: no channel behind the third, no second result."""
    if not isinstance(index, ast.Slice):
        value = constant(index, 0)
        return isinstance(value, (str, tuple)) or value in (0, None)
    start, end = constant(index.lower, 0), constant(index.upper, 3)
    return index.lower is None or (start == 0 and not 0 <= end < 3)
