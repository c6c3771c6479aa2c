"""The meaning of an expression: the kind of image, and whether it was rendered; and how meanings are joined."""

from __future__ import annotations

from typing import Iterable, NamedTuple, Optional

from legs_adapters.lexicon.words import KINDS


class Meaning(NamedTuple):
    """``kind``: image, depth, normal, ... or None; ``role``: "render", "target", "both" or None."""

    kind: Optional[str]
    role: Optional[str]


UNKNOWN = Meaning(None, None)


def more_special(word: Optional[str], flow: Optional[str]) -> Optional[str]:
    """Return the more specific of two kinds; either may be unknown."""
    kinds = [kind for kind in (word, flow) if kind is not None]
    return min(kinds, key=KINDS.index) if kinds else None


def mix(parts: Iterable[Meaning], computed: bool = False) -> Meaning:
    """Join the meanings of an expression's parts: a mask or a number applied to an image gives an image.

    So does a map of labels or of motion in what is computed, ``image * objects``.
    """
    laid_over = (None, "mask", "parameter", *(("feature", "flow") if computed else ()))
    known = [part for part in parts if part != UNKNOWN]
    known = [part for part in known if part.kind not in laid_over] or known
    kinds = [part.kind for part in known if part.kind is not None]
    roles = {part.role for part in known if part.role is not None}
    role = roles.pop() if len(roles) == 1 else "both" if roles else None
    return Meaning(min(kinds, key=KINDS.index) if kinds else None, role)


def swapped(a: Meaning, b: Meaning) -> Optional[bool]:
    """Return whether the first of two is the ground truth; None where that is not clear.

    Of a composite of both and one of them, the composite is the other.
    """
    if (b.role == "target" and a.role != "target") or (a.role == "render" and b.role in (None, "both")):
        return False
    if (a.role == "target" and b.role != "target") or (b.role == "render" and a.role in (None, "both")):
        return True
    return None
