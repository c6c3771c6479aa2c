"""Contenders in turns, and their table: medians, ratios within a round, the share of a copy's bandwidth."""

from __future__ import annotations

import statistics
from typing import Any, Dict, List, Tuple

import torch

from .contenders import Contenders
from .timing import copy_bandwidth, timed

__all__ = ["TOO_LONG", "at_bandwidth", "side_by_side"]

SLOW_ROUNDS = 3
TOO_LONG = 2.0  # seconds
# The least bytes a value, and a pixel: prediction and target are read, the gradient is written. Weights from the kernel
# take another pass over the target, which writes a map that is read and written once more; a stored map is read.
LEAST = (12, 0)
MUST_MOVE = {"LEGS, weights in the kernel": (16, 16), "LEGS, stored map": (12, 4)}


def side_by_side(contenders: Contenders, rounds: int, against: str, device: torch.device) -> Any:
    """Time all contenders in turns; print and return medians and the ratios to one of them."""
    first = {}
    for name, step in list(contenders.items()):
        try:
            first[name] = timed(step, device)  # compilation, and memory's first touch
        except Exception as error:  # torch.compile needs a C++ compiler and raises nearly anything
            print(f"{name}: it does not run here ({type(error).__name__}: {str(error).strip().splitlines()[0]})")
            del contenders[name]
    times: Dict[str, List[float]] = {name: [] for name in contenders}
    launched: Dict[str, List[float]] = {name: [] for name in contenders}  # of a GPU alone
    for i in range(rounds):
        for name, step in contenders.items():
            if i < SLOW_ROUNDS or first[name] < TOO_LONG:
                times[name].append(timed(step, device, launched[name]))
    table = {}
    against = against if against in times else next(iter(times))
    digits = 4 if device.type == "cuda" else 2
    for name, seconds in times.items():
        ratios = [ours / theirs for ours, theirs in zip(times[against], seconds)]
        table[name] = {
            "ms": [1e3 * value for value in seconds],
            "median ms": 1e3 * statistics.median(seconds),
            f"ratio of {against!r} to it": [statistics.median(ratios), min(ratios), max(ratios)],
        }
        spread = f"{statistics.median(ratios):7.4f}  ({min(ratios):.4f} to {max(ratios):.4f})"
        print(f"{name:<46} {1e3 * statistics.median(seconds):10.{digits}f} ms   ours / it {spread}", flush=True)
        if launched[name]:
            ratios = [ours / theirs for ours, theirs in zip(launched[against], launched[name])]
            table[name]["ms as launched"] = 1e3 * statistics.median(launched[name])
            table[name]["its ratio as launched"] = [statistics.median(ratios), min(ratios), max(ratios)]
            print(f"{'':<46} {table[name]['ms as launched']:10.{digits}f} ms as Python launches it", flush=True)
    return table


def at_bandwidth(table: Dict[str, Any], size: Tuple[int, int], device: torch.device) -> None:
    """Add to the rows, and print, the bytes that must move at least, and their share of the bandwidth of a copy."""
    bandwidth = copy_bandwidth(device)
    print(f"a copy moves {bandwidth / 1e9:.0f} GB/s")
    for name, row in table.items():
        (of_value, of_pixel), pixels = MUST_MOVE.get(name, LEAST), size[0] * size[1]
        row["bytes"] = (3 * of_value + of_pixel) * pixels
        least = 1e3 * row["bytes"] / bandwidth
        row["ms at a copy's bandwidth"], row["share of a copy's bandwidth"] = least, least / row["median ms"]
        megabytes, share = row["bytes"] / 1e6, row["share of a copy's bandwidth"]
        print(f"{name:<46} {megabytes:10.1f} MB   at that {least:.3f} ms, {share:.2f} of its time")
