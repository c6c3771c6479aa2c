"""The times of LEGS and of other implementations of the loss, for each size of image."""

from __future__ import annotations

from typing import Any, Callable, Dict

import torch

from benchmarks.gpu.options import Options, Record
from benchmarks.losses.contenders import losses
from benchmarks.losses.images import Pairs, in_turns, some_images
from benchmarks.losses.tables import at_bandwidth, side_by_side
from legs_loss import configure, l1_loss, ssim

__all__ = ["CONTENDERS", "L1", "LEGS", "PLAIN_L1", "WHOLE", "times"]

LEGS = "LEGS, weights in the kernel"
L1 = "l1_loss, of known views"
STEP = "l1_loss and ssim"
PLAIN_L1 = "L1 alone (torch)"
WHOLE = "fused-ssim + L1"
CONTENDERS = (
    LEGS,
    "LEGS, stored map",
    "3DGS by the kernel",
    "3DGS (torch)",
    "fused-ssim alone",
    WHOLE,
    STEP,
    L1,
    PLAIN_L1,
)


def times(options: Options, record: Record) -> None:
    """Record a table a size: medians and ratios of :data:`CONTENDERS` in turns, eight pairs of images in rotation."""
    device = options.device()
    for name in options.sizes:
        width, height = (int(side) for side in name.split("x"))
        print(f"\nforward and backward, {name} RGB", flush=True)
        pairs = some_images((width, height), device)
        contenders = {**losses(pairs), **_l1_terms(pairs)}
        contenders = {each: contenders[each] for each in CONTENDERS if each in contenders}
        table = side_by_side(contenders, options.rounds, LEGS, device)
        at_bandwidth(table, (width, height), device)
        for missing in (each for each in CONTENDERS if each not in table):
            table[missing] = {"skipped": "needs CUDA" if options.emulate else "fused-ssim is not installed"}
        record(**{name: table})


def _l1_terms(pairs: Pairs) -> Dict[str, Callable[[], Any]]:
    """Return torch's plain L1, and what a patched line calls, which knows each view's range after its first call."""
    configure("legs")
    return {
        L1: in_turns(pairs, lambda image, target, _: l1_loss(image, target)),
        STEP: in_turns(
            pairs, lambda image, target, _: 0.8 * l1_loss(image, target) + 0.2 * (1.0 - ssim(image, target))
        ),
        PLAIN_L1: in_turns(pairs, lambda image, target, _: torch.abs(image - target).mean()),
    }
