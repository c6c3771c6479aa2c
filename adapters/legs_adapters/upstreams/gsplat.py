"""gsplat: weight ``gsplat.losses.l1_loss``, which its trainers and others' call with a rendering and a photograph.

That function takes tensors of any shape and returns unreduced errors. It is weighted for trained images of three
channels in either layout; depths, intensities and everything without a gradient are unchanged. A target that requires a
gradient is not a photograph. Its ``ssim_loss`` of such images is the mean over what a mask of the store counts.
Source: gsplat/losses.py, which gsplat has after its release 1.5.3.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any, Optional

import legs_loss
from legs_loss.upstreams import Applied

__all__ = ["apply"]


def apply(applied: Applied) -> None:
    """Replace gsplat's l1_loss and ssim_loss."""
    losses = importlib.import_module("gsplat.losses")
    own = losses.l1_loss
    own_ssim: Any = getattr(losses, "ssim_loss", None)

    @functools.wraps(own)
    def l1_loss(pred: Any, target: Any) -> Any:
        channels_last = _channels_last(pred, target)
        if channels_last is None:
            return own(pred, target)
        return legs_loss.l1_loss(pred, target, channels_last=channels_last, own=own)

    @functools.wraps(own_ssim or own)
    def ssim_loss(pred: Any, target: Any, *settings: Any, **named: Any) -> Any:
        if _channels_last(pred, target) is None:
            return own_ssim(pred, target, *settings, **named)
        loss = own_ssim(legs_loss.masked(pred, target), target, *settings, **named)
        return loss / legs_loss.coverage(pred, target)

    applied.replace(losses, "l1_loss", l1_loss)
    if own_ssim is not None:
        applied.replace(losses, "ssim_loss", ssim_loss)


def _channels_last(image: Any, target: Any) -> Optional[bool]:
    """Return whether the channels of a rendering and its photograph, [..., H, W, 3] or [..., 3, H, W], come last.

    None for other tensors.
    """
    if image.shape != target.shape or target.requires_grad or image.dim() < 3 or not image.is_floating_point():
        return None
    first, last = image.shape[-3] == 3, image.shape[-1] == 3
    return last if first != last else None
