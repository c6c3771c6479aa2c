"""The meaning of an expression: the kind of image, and whether it was rendered; and how meanings are joined."""

from __future__ import annotations

from typing import Iterable, NamedTuple, Optional

from legs_adapters.lexicon.words import KINDS

__all__ = ["UNKNOWN", "Meaning", "mix", "more_special", "swapped"]


class Meaning(NamedTuple):
    """``kind``: image, depth, normal, ... or None; ``role``: "render", "target", "both" or None."""

    kind: Optional[str]
    role: Optional[str]


UNKNOWN = Meaning(None, None)


def more_special(word: Optional[str], flow: Optional[str]) -> Optional[str]:
    """Return the more specific of two kinds; either may be unknown."""
    kinds = [kind for kind in (word, flow) if kind is not None]
    return min(kinds, key=KINDS.index) if kinds else None


def mix(parts: Iterable[Meaning]) -> Meaning:
    """Join the meanings of an expression's parts: a mask or a number applied to an image gives an image."""
    known = [part for part in parts if part != UNKNOWN]
    if not known:
        return UNKNOWN
    pictures = [part for part in known if part.kind not in (None, "mask", "parameter")]
    if pictures:
        kind = min((part.kind for part in pictures if part.kind is not None), key=KINDS.index)
        roles = {part.role for part in pictures if part.role is not None}
    else:
        kinds = [part.kind for part in known if part.kind is not None]
        kind = min(kinds, key=KINDS.index) if kinds else None  # type: ignore[assignment]
        roles = {part.role for part in known if part.role is not None}
    role = roles.pop() if len(roles) == 1 else "both" if roles else None
    return Meaning(kind, role)


def swapped(a: Meaning, b: Meaning) -> Optional[bool]:
    """Return whether the first of two is the ground truth; None where that is not clear."""
    if b.role == "target" and a.role != "target":
        return False
    if a.role == "target" and b.role != "target":
        return True
    if a.role == "render" and b.role is None:
        return False
    if b.role == "render" and a.role is None:
        return True
    # of a composite of both and one of them, the composite is the other
    if (a.role == "render" and b.role == "both") or (a.role == "both" and b.role == "target"):
        return False
    if (a.role == "both" and b.role == "render") or (a.role == "target" and b.role == "both"):
        return True
    return None
