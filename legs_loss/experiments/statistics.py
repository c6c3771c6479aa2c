"""What rows say: means and spreads over seeds, and differences paired view by view with an interval."""

from __future__ import annotations

import math
import warnings
from typing import Any, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from legs_loss.errors import LegsError

__all__ = ["SCORES", "Difference", "Summary", "difference", "summarise", "summarise_all", "times_gaussians"]

Rows = Sequence[Mapping[str, Any]]

# A column's name, and where a row's metrics have it.
SCORES: Mapping[str, Tuple[str, ...]] = {
    "train PSNR": ("train", "psnr"),
    "train SSIM": ("train", "ssim"),
    "held-out PSNR": ("test", "psnr"),
    "held-out SSIM": ("test", "ssim"),
    "strongest 10%": ("test", "psnr_strong"),
    "the rest": ("test", "psnr_rest"),
    "Gaussians": ("gaussians",),
    "ms an iteration": (),
    "mean weight": ("mean_weight",),
}

RESAMPLES = 9999


class Summary(NamedTuple):
    """One arm: the number of its seeds, and of each of :data:`SCORES` its mean and standard deviation over them.

    The mean of "ms an iteration" is the median.
    """

    arm: str
    seeds: int
    mean: Mapping[str, float]
    spread: Mapping[str, float]


class Difference(NamedTuple):
    """An arm's score minus another's, paired by view.

    mean: over views, each view's mean over seeds.
    low, high: the ends of its 95% interval, resampling views; NaN where there are fewer than two.
    seeds: the mean over views of each seed alone, since an interval over views does not know how seeds scatter.
    """

    mean: float
    low: float
    high: float
    seeds: Tuple[float, ...]

    @property
    def clear(self) -> bool:
        """Whether the interval excludes 0 and every seed has the same sign."""
        return bool(self.low * self.high > 0 and all(seed * self.mean > 0 for seed in self.seeds))


def summarise(rows: Rows) -> Summary:
    """Return the summary of one arm's rows.

    >>> metrics = {"train": {"psnr": 30.0, "ssim": 0.9}, "test": None, "gaussians": 5, "mean_weight": 1.0,
    ...            "processor_seconds": 2.0, "iterations": 100}
    >>> other = dict(metrics, gaussians=7)
    >>> summary = summarise([{"arm": "a", "metrics": metrics}, {"arm": "a", "metrics": other}])
    >>> summary.mean["Gaussians"], round(summary.spread["Gaussians"], 3), summary.mean["ms an iteration"]
    (6.0, 1.414, 20.0)
    """
    mean, spread = {}, {}
    for name in SCORES:
        values = np.array([_value(row["metrics"], name) for row in rows])
        # A machine's first row compiles the kernels, which is no iteration's time.
        mean[name] = float(np.median(values) if name == "ms an iteration" else values.mean())
        spread[name] = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    return Summary(rows[0]["arm"], len(rows), mean, spread)


def summarise_all(rows: Rows, arms: Sequence[str]) -> List[Summary]:
    """Return the summaries of the arms that have rows, in this order."""
    return [summarise(own) for own in (_of(rows, arm) for arm in arms) if own]


def difference(rows: Rows, arm: str, reference: str, split: str = "test", score: str = "psnr") -> Optional[Difference]:
    """Return by how much ``arm`` exceeds ``reference``, over the seeds that both have; None if they share none.

    Args:
        rows: of any arms.
        arm, reference: two arms' names.
        split: "train" or "test".
        score: "psnr", "ssim", "psnr_strong" or "psnr_rest".

    Raises:
        LegsError: the two were scored on other views.
    """
    ours, theirs = _scores(rows, arm, split, score), _scores(rows, reference, split, score)
    seeds = sorted(set(ours) & set(theirs))
    if not seeds or not ours[seeds[0]]:
        return None
    views = sorted(ours[seeds[0]])
    if any(sorted(scores[seed]) != views for scores in (ours, theirs) for seed in seeds):
        raise LegsError(f"{arm} and {reference} were scored on other views")
    table = np.array([[ours[seed][view] - theirs[seed][view] for view in views] for seed in seeds])
    low, high = _interval(table.mean(0))
    return Difference(float(table.mean()), low, high, tuple(table.mean(1).tolist()))


def times_gaussians(rows: Rows, arm: str, reference: str) -> Optional[float]:
    """Return how many times as many Gaussians ``arm`` has, over the seeds that both have; None if they share none."""
    ours, theirs = ({row["seed"]: row["metrics"]["gaussians"] for row in _of(rows, name)} for name in (arm, reference))
    seeds = set(ours) & set(theirs)
    return sum(ours[seed] for seed in seeds) / sum(theirs[seed] for seed in seeds) if seeds else None


def _interval(values: np.ndarray) -> Tuple[float, float]:
    """The 95% interval of the mean: bias-corrected and accelerated bootstrap."""
    from scipy.stats import bootstrap

    if len(values) < 2:
        return math.nan, math.nan
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of resamples that are all one view
        result = bootstrap((values,), np.mean, n_resamples=RESAMPLES, random_state=np.random.default_rng(0))
    return float(result.confidence_interval.low), float(result.confidence_interval.high)


def _of(rows: Rows, arm: str) -> List[Mapping[str, Any]]:
    return [row for row in rows if row["arm"] == arm]


def _scores(rows: Rows, arm: str, split: str, score: str) -> Dict[int, Dict[str, float]]:
    return {
        row["seed"]: {view: values[score] for view, values in row["metrics"]["views"][split].items()}
        for row in _of(rows, arm)
    }


def _value(metrics: Mapping[str, Any], name: str) -> float:
    if name == "ms an iteration":
        return 1000.0 * metrics.get("processor_seconds", math.nan) / metrics["iterations"]
    value: Any = metrics
    for key in SCORES[name]:
        if value is None:  # no view is held out
            return math.nan
        value = value.get(key, math.nan)
    return float(value)
