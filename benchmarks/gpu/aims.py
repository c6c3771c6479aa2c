"""The aims beside the measurements."""

from __future__ import annotations

from typing import Any, Dict

from benchmarks.gpu.measured import EQUAL
from benchmarks.gpu.times import LEGS

__all__ = ["judged"]


def judged(results: Dict[str, Any]) -> Dict[str, str]:
    """Return of each aim whether the results meet it, with the numbers; of an emulated run, that nothing was measured.

    >>> row = {"median ms": 1.0, "share of a copy's bandwidth": 0.6}
    >>> table = {LEGS: row, "fused-ssim alone": {"median ms": 3.0}}
    >>> training = {"plain": {"ms a step": 10.0, EQUAL: 8.0}, "LEGS": {"ms a step": 11.0, EQUAL: 7.6}}
    >>> for aim in judged({"times": {"800x533": table}, "fastgs": training}).items():
    ...     print(*aim, sep=": ")
    800x533, at most half of fused-ssim's time: met (0.33)
    800x533, at least half of a copy's bandwidth: met (0.60)
    fastgs, a LEGS step no slower than a plain one, with as many Gaussians: met (0.95)
    fastgs, a LEGS step no slower than a plain one, over the whole training: missed (1.10)
    """
    if results.get("machine", {}).get("emulated"):
        return {"aims": "not measured: the kernels were emulated"}
    found = {}
    for size, table in results.get("times", {}).items():
        ours = table.get(LEGS, {}) if isinstance(table, dict) else {}
        theirs = table.get("fused-ssim alone", {}) if isinstance(table, dict) else {}
        if "median ms" in ours and "median ms" in theirs:
            ratio = ours["median ms"] / theirs["median ms"]
            found[f"{size}, at most half of fused-ssim's time"] = _verdict(ratio, ratio <= 0.5)
        if "share of a copy's bandwidth" in ours:
            share = ours["share of a copy's bandwidth"]
            found[f"{size}, at least half of a copy's bandwidth"] = _verdict(share, share >= 0.5)
    for name in ("fastgs", "gsplat"):
        arms = results.get(name, {})
        for steps, words in ((EQUAL, "with as many Gaussians"), ("ms a step", "over the whole training")):
            if all(steps in arms.get(arm, {}) for arm in ("plain", "LEGS")):
                ratio = arms["LEGS"][steps] / arms["plain"][steps]
                found[f"{name}, a LEGS step no slower than a plain one, {words}"] = _verdict(ratio, ratio <= 1.0)
    return found or {"aims": "not measured"}


def _verdict(number: float, met: bool) -> str:
    return f"{'met' if met else 'missed'} ({number:.2f})"
