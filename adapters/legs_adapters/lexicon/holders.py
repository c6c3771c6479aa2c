"""Find the role of an expression from its container: ``outputs["rgb"]`` is a rendering, ``batch["rgb"]`` a target."""

from __future__ import annotations

from typing import TYPE_CHECKING, Optional

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.syntax import call_name, key_of, same, walk_expressions, words
from legs_adapters.lexicon.names import role_of_words
from legs_adapters.lexicon.words import DATA, RENDERERS

if TYPE_CHECKING:
    from legs_adapters.lexicon.depiction import Meanings

__all__ = ["role_of_holder"]


def role_of_holder(meanings: Meanings, function: Function, node: cst.CSTNode, depth: int) -> Optional[str]:
    """Return the role from the container: ``outputs["rgb"]`` is rendered, ``batch["rgb"]`` a target."""
    if isinstance(node, cst.Name):
        found = set(words(node.value))
        name_role = role_of_words(node.value)
        if name_role is not None:
            return name_role
        if found & DATA and not _is_rendered(function, node):
            return _given_role(meanings, function, node) or "target"  # a camera may have been anywhere before
        return meanings.flow(function, node, depth + 1).role
    if isinstance(node, cst.Attribute):
        role = role_of_words(node.attr.value)
        if role is None and set(words(node.attr.value)) & DATA:
            return "target"
        return role or role_of_holder(meanings, function, node.value, depth + 1)
    if isinstance(node, cst.Subscript):
        return role_of_holder(meanings, function, node.value, depth + 1)
    return meanings.of(function, node, depth).role


def _given_role(meanings: Meanings, function: Function, node: cst.Name) -> Optional[str]:
    """Return the role of a parameter ``data`` that training gives ``data["render_results"]`` at each call."""
    if {definition.kind for definition in function.flow.reaching(node)} != {"parameter"}:
        return None
    given = [function.given(call, node.value) for _, call in meanings.training.sites.get(function, [])]
    keys = [key_of(value) for value in given if isinstance(value, cst.Subscript)]
    said = [isinstance(key, str) and bool(set(words(key)) & RENDERERS) for key in keys]
    return "render" if said and all(said) and len(said) == len(given) else None


def _is_rendered(function: Function, node: cst.Name) -> bool:
    """Return whether ``view = render(camera)`` made it; ``data = render(data)`` keeps its earlier entries, too."""
    made = [definition.value for definition in function.flow.reaching(node)]
    return any(
        isinstance(call, cst.Call)
        and bool(set(words(call_name(call))) & RENDERERS)
        and not any(same(part, node) for arg in call.args for part in walk_expressions(arg.value))
        for call in made
    )
