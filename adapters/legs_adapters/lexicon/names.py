"""Read names: the kind of image, whether it is a rendering or a photograph, an L1 function; and what a file imports."""

from __future__ import annotations

import functools
import re
from typing import Optional

from legs_adapters.code.syntax import words
from legs_adapters.lexicon.words import (
    KIND_OF,
    KINDS,
    LAID_OVER,
    OF_PICTURES,
    PERCEPTUAL,
    RENDER,
    TARGET,
)

TORCH_L1 = re.compile(r"(^|\.)(torch\.nn\.functional|nn\.functional|functional)\.l1_loss$")
_L1_NAME = re.compile(
    r"^(masked|mask|weighted|pixel|pixelwise|rgb|color|image|photometric)*l1(loss)?(loss|mask(ed)?|rgb|withmask|v\d+)*$"
)

_TORCH = re.compile(r"^[ \t]*(import|from)[ \t]+torch", re.M)
_OTHER_FRAMEWORK = re.compile(
    r"^[ \t]*(import|from)[ \t]+(drjit|flax|jax|jittor|megengine|mindspore|mlx|paddle|tensorflow|tinygrad)\b", re.M
)


def kind_of_words(name: str) -> Optional[str]:
    """Return the kind of image in a name; the most specific of several."""
    tokens = words(name)
    if LAID_OVER & {*tokens[-1:]}:
        return "mask"  # applied to an image, it gives an image
    kinds = {KIND_OF[word] for word in tokens if word in KIND_OF}
    if "image" in kinds:  # sky_rgb, render_sh
        kinds = {KIND_OF[word] for word in tokens if word in KIND_OF and word not in OF_PICTURES}
    return min(kinds, key=KINDS.index) if kinds else None


def role_of_words(name: str) -> Optional[str]:
    """Return the role in a name, None without one."""
    found = set(words(name))
    target, render = bool(found & TARGET), bool(found & RENDER)
    if target and render:  # rendered_gt, gt_pred: the name does not decide
        return None
    return "target" if target else "render" if render else None


def has_perceptual_name(name: str) -> bool:
    """Return whether the name of a function or a class is of a perceptual loss."""
    return not PERCEPTUAL.isdisjoint(words(name))


def is_l1_name(name: str) -> bool:
    """Return whether a function is an L1, by its name."""
    return _L1_NAME.match(name.replace("_", "").lower()) is not None


@functools.lru_cache(maxsize=8)
def is_of_other_framework(text: str) -> bool:
    """Return whether a file imports another framework of tensors and no torch."""
    return _OTHER_FRAMEWORK.search(text) is not None and not _TORCH.search(text)
