"""The aims beside the measurements."""

from __future__ import annotations

from typing import Any, Dict

from benchmarks.cuda_instructions import BUDGET, CARDS
from benchmarks.gpu.measured import EQUAL
from benchmarks.gpu.times import L1, LEGS, PLAIN_L1, WHOLE

__all__ = ["judged"]


def judged(results: Dict[str, Any]) -> Dict[str, str]:
    """Return of each aim whether the results meet it, with the numbers; of an emulated run, that nothing was measured.

    >>> table = {LEGS: {"median ms": 0.026}, "fused-ssim alone": {"median ms": 0.078}}
    >>> table.update({L1: {"ms as launched": 0.11}, "L1 alone (torch)": {"ms as launched": 0.1}})
    >>> training = {"plain": {"ms a step": 10.0, EQUAL: 8.0}, "LEGS": {"ms a step": 11.0, EQUAL: 7.6}}
    >>> for aim in judged({"machine": {"gpu": "NVIDIA H200"}, "times": {"800x533": table}, "fastgs": training}).items():
    ...     print(*aim, sep=": ")
    800x533, at most half of fused-ssim's time: met (0.33)
    800x533, as launched at most 1.0 of the time of L1 alone (torch): missed (1.10)
    800x533, at least 0.6 of the issue limit: met (0.64)
    fastgs, a LEGS step no slower than a plain one, with as many Gaussians: met (0.95)
    fastgs, a LEGS step no slower than a plain one, over the whole training: missed (1.10)
    """
    if results.get("machine", {}).get("emulated"):
        return {"aims": "not measured: the kernels were emulated"}
    found = {}
    card = next((name for name in CARDS if name.split()[-1] in str(results.get("machine", {}))), None)
    for size, table in results.get("times", {}).items():
        ours = table.get(LEGS, {}) if isinstance(table, dict) else {}
        theirs = table.get("fused-ssim alone", {}) if isinstance(table, dict) else {}
        if "median ms" in ours and "median ms" in theirs:
            ratio = ours["median ms"] / theirs["median ms"]
            found[f"{size}, at most half of fused-ssim's time"] = _verdict(ratio, ratio <= 0.5)
        for mine, other, most in ((L1, PLAIN_L1, 1.0), (LEGS, WHOLE, 0.6)):
            rows = [table.get(name, {}) if isinstance(table, dict) else {} for name in (mine, other)]
            if all("ms as launched" in row for row in rows):
                ratio = rows[0]["ms as launched"] / rows[1]["ms as launched"]
                found[f"{size}, as launched at most {most} of the time of {other}"] = _verdict(ratio, ratio <= most)
        if "median ms" in ours and card is not None:
            share = _issue_ms(size, card) / ours["median ms"]
            found[f"{size}, at least 0.6 of the issue limit"] = _verdict(share, share >= 0.6)
    for name in ("fastgs", "gsplat"):
        arms = results.get(name, {})
        for steps, words in ((EQUAL, "with as many Gaussians"), ("ms a step", "over the whole training")):
            if all(steps in arms.get(arm, {}) for arm in ("plain", "LEGS")):
                ratio = arms["LEGS"][steps] / arms["plain"][steps]
                found[f"{name}, a LEGS step no slower than a plain one, {words}"] = _verdict(ratio, ratio <= 1.0)
    return found or {"aims": "not measured"}


def _issue_ms(size: str, card: str) -> float:
    """Return how long a card takes to issue the instructions of the loss of RGB images of a size, such as "800x533"."""
    width, height = map(int, size.split("x"))
    processors, clock, _ = CARDS[card]
    return 1e3 * BUDGET["weights inside"].most * 3 * width * height / 32 / (4 * processors * clock)


def _verdict(number: float, met: bool) -> str:
    return f"{'met' if met else 'missed'} ({number:.2f})"
