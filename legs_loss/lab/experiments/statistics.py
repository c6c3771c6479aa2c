"""Means and spreads of rows over seeds, and differences paired view by view with an interval."""

from __future__ import annotations

import math
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.lab.training.metrics import METRICS

Rows = Sequence[Mapping[str, Any]]


class Column(NamedTuple):
    """A column of a table of arms.

    label: its head.
    format: of a value.
    value: of a row's metrics; NaN where the row lacks it.
    middle: of values over seeds, in place of the mean.
    spread: whether the standard deviation over seeds is shown.
    metric: the split and the key in METRICS, where it is a metric's.
    """

    label: str
    format: str
    value: Callable[[Mapping[str, Any]], float]
    middle: Callable[[np.ndarray], Any] = np.mean
    spread: bool = True
    metric: Optional[Tuple[str, str]] = None


def _metric_columns(split: str) -> List[Column]:
    return [
        Column(
            metric.column(split),
            metric.format,
            # No view may be held out; a row may be older than the metric.
            lambda metrics, key=key: (metrics[split] or {}).get(key, math.nan),  # type: ignore[misc]
            metric=(split, key),
        )
        for key, metric in METRICS.items()
        if split in metric.splits
    ]


def _milliseconds(metrics: Mapping[str, Any]) -> float:
    return 1000.0 * metrics.get("processor_seconds", math.nan) / metrics["iterations"]


COLUMNS: Tuple[Column, ...] = (
    *_metric_columns("train"),
    *_metric_columns("test"),
    Column("Gaussians", ",.0f", lambda metrics: metrics["gaussians"]),
    # A machine's first row compiles the kernels, outside of any iteration: hence the median.
    Column("ms an iteration", ".0f", _milliseconds, np.median, spread=False),
    Column("mean weight", ".2f", lambda metrics: metrics.get("mean_weight", math.nan), spread=False),
)

RESAMPLES = 9999


class Summary(NamedTuple):
    """One arm: the number of its seeds, and by label of each of :data:`COLUMNS` its mean and standard deviation."""

    arm: str
    seeds: int
    mean: Mapping[str, float]
    spread: Mapping[str, float]


class Difference(NamedTuple):
    """An arm's score minus another's, paired by view.

    mean: over views, each view's mean over seeds.
    low, high: the ends of its 95% interval, see :func:`interval`.
    seeds: the mean over views of each seed: with few seeds, no interval estimates their spread well.
    """

    mean: float
    low: float
    high: float
    seeds: Tuple[float, ...]

    @property
    def clear(self) -> bool:
        """Return whether the interval excludes 0 and every seed has the same sign."""
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
    for column in COLUMNS:
        values = np.array([column.value(row["metrics"]) for row in rows], float)
        mean[column.label] = float(column.middle(values))
        spread[column.label] = float(values.std(ddof=1)) if len(values) > 1 else math.nan
    return Summary(rows[0]["arm"], len(rows), mean, spread)


def summarise_all(rows: Rows, arms: Sequence[str]) -> List[Summary]:
    """Return the summaries of the arms that have rows, in this order."""
    return [summarise(found) for found in (_of(rows, arm) for arm in arms) if found]


def difference(rows: Rows, arm: str, reference: str, split: str = "test", score: str = "psnr") -> Optional[Difference]:
    """Return by how much ``arm`` exceeds ``reference``, over the seeds that both have; None if they share none.

    It is None too where a row is older than the metric and lacks it.

    Args:
        rows: of any arms.
        arm, reference: two arms' names.
        split: "train" or "test".
        score: a key of :data:`~legs_loss.lab.training.metrics.METRICS`.

    Raises:
        LegsError: the two were scored on other views.
    """
    return pooled_difference([rows], arm, reference, split, score)


def pooled_difference(
    scenes: Sequence[Rows], arm: str, reference: str, split: str = "test", score: str = "psnr"
) -> Optional[Difference]:
    """Return :func:`difference` over several scenes, each with the same share in the mean; None if one has none.

    Its ``seeds`` are means over the scenes of those seeds that all scenes have.
    """
    tables = [_table(rows, arm, reference, split, score) for rows in scenes]
    found = [table for table in tables if table is not None]
    if not found or len(found) < len(scenes):
        return None
    low, high = interval(found)
    mean = sum(float(table.mean()) for table in found) / len(found)
    seeds = zip(*(table.mean(1) for table in found))
    return Difference(mean, low, high, tuple(float(np.mean(each)) for each in seeds))


def interval(tables: Sequence[np.ndarray], resamples: int = RESAMPLES) -> Tuple[float, float]:
    """Return the 95% interval of the mean of tables [seeds, views]: a hierarchical bootstrap over both.

    Each resample draws, in every table, seeds and views with replacement, independently of each other, since a seed's
    training is scored on all views; the ends are percentiles. With one seed it is the bootstrap over views. The tables,
    one a scene, count the same and are not resampled: the interval is for these scenes.

    Returns:
        NaN, NaN where a table has fewer than two views.

    Source: A. B. Owen, The pigeonhole bootstrap (2007), which is a little wide and never too narrow as the table grows;
    from three seeds any bootstrap is too narrow.

    >>> interval([np.full((3, 4), 0.5)])
    (0.5, 0.5)
    """
    if any(table.shape[1] < 2 for table in tables):
        return math.nan, math.nan
    generator = np.random.default_rng(0)
    means = np.zeros(resamples)
    for table in tables:
        seeds, views = (
            generator.multinomial(count, np.full(count, 1.0 / count), resamples) / count for count in table.shape
        )
        means += np.einsum("rs,sv,rv->r", seeds, table, views, optimize=True) / len(tables)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def times_gaussians(rows: Rows, arm: str, reference: str) -> Optional[float]:
    """Return how many times as many Gaussians ``arm`` has, over the seeds that both have; None if they share none."""
    ours, theirs = ({row["seed"]: row["metrics"]["gaussians"] for row in _of(rows, name)} for name in (arm, reference))
    seeds = set(ours) & set(theirs)
    return sum(ours[seed] for seed in seeds) / sum(theirs[seed] for seed in seeds) if seeds else None


def _table(rows: Rows, arm: str, reference: str, split: str, score: str) -> Optional[np.ndarray]:
    """Return the differences [seeds, views]; None if the arms share no seed or a row lacks the metric."""
    ours, theirs = _scores(rows, arm, split, score), _scores(rows, reference, split, score)
    seeds = sorted(set(ours) & set(theirs))
    if not seeds or not ours[seeds[0]]:
        return None
    views = sorted(ours[seeds[0]])
    if any(sorted(scores[seed]) != views for scores in (ours, theirs) for seed in seeds):
        raise LegsError(f"{arm} and {reference} were scored on other views")
    table = np.array([[ours[seed][view] - theirs[seed][view] for view in views] for seed in seeds])
    return None if np.isnan(table).any() else table


def _of(rows: Rows, arm: str) -> List[Mapping[str, Any]]:
    return [row for row in rows if row["arm"] == arm]


def _scores(rows: Rows, arm: str, split: str, score: str) -> Dict[int, Dict[str, float]]:
    return {
        row["seed"]: {view: values.get(score, math.nan) for view, values in row["metrics"]["views"][split].items()}
        for row in _of(rows, arm)
    }
