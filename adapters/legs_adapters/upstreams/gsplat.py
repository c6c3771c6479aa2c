"""gsplat: weight ``gsplat.losses.l1_loss``, which its trainers and others' call with a rendering and a photograph.

That function takes tensors of any shape and returns unreduced errors. It is weighted for trained images of three
channels in either layout; depths, intensities and everything without a gradient are unchanged. A target that requires a
gradient is not a photograph. Source: gsplat/losses.py, which gsplat has after its release 1.5.3.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any, Optional

import legs_loss
from legs_loss.upstreams import Applied

__all__ = ["apply"]


def apply(applied: Applied) -> None:
    """Replace gsplat's l1_loss."""
    losses = importlib.import_module("gsplat.losses")
    own = losses.l1_loss

    @functools.wraps(own)
    def l1_loss(pred: Any, target: Any) -> Any:
        channels_last = _channels_last(pred) if pred.shape == target.shape else None
        if channels_last is None or target.requires_grad:
            return own(pred, target)
        return legs_loss.l1_loss(pred, target, channels_last=channels_last, own=own)

    applied.replace(losses, "l1_loss", l1_loss)


def _channels_last(image: Any) -> Optional[bool]:
    """Return whether an image's channels come last, None for other tensors: [..., H, W, 3] or [..., 3, H, W]."""
    if image.dim() < 3 or not image.is_floating_point():
        return None
    first, last = image.shape[-3] == 3, image.shape[-1] == 3
    return last if first != last else None
