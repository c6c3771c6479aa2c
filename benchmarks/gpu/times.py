"""The times of LEGS and of other implementations of the loss, for each size of image."""

from __future__ import annotations

from typing import Any, Callable, Dict

import torch
from torch import Tensor

from benchmarks.gpu.options import Options, Record
from benchmarks.losses.contenders import losses
from benchmarks.losses.images import Pairs, in_turns, some_images
from benchmarks.losses.tables import at_bandwidth, side_by_side
from legs_loss.kernels import backends
from legs_loss.kernels.contract import Weights
from legs_loss.spec import PRESETS

__all__ = ["CONTENDERS", "L1", "LEGS", "times"]

LEGS = "LEGS, weights in the kernel"
L1 = "LEGS L1 alone, remembered range"
CONTENDERS = (
    LEGS,
    "LEGS, stored map",
    "3DGS by the kernel",
    "3DGS (torch)",
    "fused-ssim alone",
    "fused-ssim + L1",
    L1,
    "L1 alone (torch)",
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
    """Return torch's plain L1, and the weighted one as ``l1_loss`` computes it once it knows a view's range."""
    spec = PRESETS["legs"]
    ranges = [backends.fused_range(target, spec) for _, target in pairs]

    def weighted(image: Tensor, target: Tensor, i: int) -> Tensor:
        value = backends.fused_l1(image, target, Weights(spec=spec, range=ranges[i]))
        assert value is not None, "the kernels are not used"
        return value

    return {
        L1: in_turns(pairs, weighted),
        "L1 alone (torch)": in_turns(pairs, lambda image, target, _: torch.abs(image - target).mean()),
    }
