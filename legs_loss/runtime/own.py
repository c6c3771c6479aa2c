"""The check that a codebase's own function is an L1, whose difference a weight may change."""

from __future__ import annotations

import weakref
from contextlib import nullcontext
from functools import partial
from typing import Any, Callable, ContextManager, Hashable, Set, Tuple

import torch
from torch import Tensor

from legs_loss.autograd import is_compiling
from legs_loss.errors import LegsError
from legs_loss.kernels.available import is_capturing

_SMALL, _TIMES = 1 / 64, 256  # differences, exact in every type of float; a weight makes the one of the other
_CLOSE = 0.02  # Charbonnier's root with its usual 1e-3 grows as an L1 within this
_MOST = 256
_known: Set[Hashable] = set()


def check_own(own: Callable[..., Any], target: Tensor) -> None:
    """Check once that a function of two images is an L1 of their difference: it grows as the difference does.

    It is asked of two images of one value each. One that makes nothing of these is asked again in the next step.

    Args:
        own: the function of (prediction, target).
        target: an image of the shape, type and device of what it is called with.

    Raises:
        LegsError: it is a squared, smooth, robust or clamped loss. (In a graph of torch.compile: a RuntimeError.)
    """
    key = None if is_compiling() else _key(own)
    if key in _known or is_capturing(target.device) or torch.jit.is_tracing():
        return
    if key is None:
        may_be, _, _ = _asked(own, target, nullcontext)
        torch._assert_async(may_be, "own= is no L1: a weight on the difference would not be one on the loss")
        return
    alike = partial(torch.random.fork_rng, [target.device] if target.device.type == "cuda" else [])
    try:
        with torch.no_grad():
            is_l1, is_known, grown = (found.item() for found in _asked(own, target, alike))
    except RuntimeError:  # tensors without values; what it raises itself comes from the loss, too
        return
    if not is_l1:
        raise LegsError(
            f"own= is no L1: {_TIMES} times the difference gives {grown:,.0f} times the loss, which no weight scales. "
            "Where a setting chooses it, choose the L1; else leave this line to the codebase's own loss, or LEGS_OFF=1"
        )
    if is_known:
        if len(_known) >= _MOST:
            _known.clear()
        _known.add(key)


def _asked(own: Callable[..., Any], target: Tensor, alike: Callable[[], ContextManager[Any]]) -> Tuple[Tensor, ...]:
    """Return whether a function may be an L1, whether it makes anything of a difference, and how many times that grows.

    Of several tensors that it returns, one is to be an L1. In ``alike`` its second call draws the numbers of its first.
    """
    grey, sums = torch.full(target.shape, 0.5, dtype=target.dtype, device=target.device), []
    for difference in (_SMALL, _SMALL * _TIMES):
        with alike():
            found = own(grey + difference, grey)
        each = found if isinstance(found, (tuple, list)) else [found]
        sums.append(torch.stack([one.double().abs().sum() for one in each if isinstance(one, Tensor)]))
    small, grown = sums[0], sums[1] / sums[0]
    return (~(small > 0) | ((grown / _TIMES - 1).abs() < _CLOSE)).any(), (small > 0).any(), grown[0]


def _key(own: Any, depth: int = 0) -> Hashable:
    """Return what stays the same where a lambda is made anew in every step: its code, and the functions in it."""
    own = getattr(own, "func", own)  # of functools.partial
    code, cells = getattr(own, "__code__", None), getattr(own, "__closure__", None) or ()
    if code is None:
        return id(own) if isinstance(own, type(len)) else weakref.ref(own)
    inner = [cell.cell_contents for cell in cells] if depth < 4 else []
    return (code, *(_key(each, depth + 1) for each in inner if callable(each)))
