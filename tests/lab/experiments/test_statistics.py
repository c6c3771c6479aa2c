"""The statistics of a comparison: paired differences, intervals, tables, by hand and against scipy."""

from __future__ import annotations

import math
from typing import Any, Dict

import numpy as np
import pytest

from legs_loss import LegsError
from legs_loss.lab.commands.demo import table as demo_table
from legs_loss.lab.experiments.statistics import difference, interval, pooled_difference, summarise, times_gaussians
from legs_loss.lab.experiments.tables import differences_table, markdown, scores_table, tables

pytest.importorskip("numba")
pytest.importorskip("scipy")

from scipy.stats import bootstrap


def row_of(arm: str, seed: int, train_psnr: Dict[str, float], gaussians: int = 100) -> Dict[str, Any]:
    views = {
        view: {"psnr": value, "ssim": value / 40, "psnr_strong": value - 5, "psnr_rest": value + 1}
        for view, value in train_psnr.items()
    }
    mean = {name: float(np.mean([scores[name] for scores in views.values()])) for name in views["a"]}
    metrics = {
        "train": mean,
        "test": mean,
        "gaussians": gaussians,
        "mean_weight": 1.0,
        "processor_seconds": 3.0,
        "iterations": 100,
        "views": {"train": views, "test": views},
    }
    return {"arm": arm, "seed": seed, "metrics": metrics}


def test_differences_are_paired_by_view() -> None:
    """Views scatter by 10 dB, the gain by 0.1 dB: unpaired nothing would be seen."""
    plain = {view: 20.0 + 10 * index for index, view in enumerate("abcde")}
    gains = (0.4, 0.5, 0.6, 0.5, 0.5)
    better = {view: value + gain for (view, value), gain in zip(plain.items(), gains)}
    best = {view: value + 0.2 for view, value in better.items()}
    rows = [row_of("3dgs", 0, plain), row_of("legs", 0, better), row_of("3dgs", 1, plain), row_of("legs", 1, best)]
    found = difference(rows, "legs", "3dgs")
    assert found is not None
    assert found.mean == pytest.approx(0.6)
    assert found.seeds == pytest.approx((0.5, 0.7))
    assert 0.3 < found.low <= 0.5 and 0.7 <= found.high < 0.9  # a quarter of the resamples has one seed alone
    assert found.clear
    opposite = difference(
        [*rows[:3], row_of("legs", 1, {view: value - 0.1 for view, value in plain.items()})], "legs", "3dgs"
    )
    assert opposite is not None and not opposite.clear  # its seeds disagree
    assert difference(rows, "legs", "eggs") is None
    same = difference(rows, "3dgs", "3dgs")
    assert same is not None and (same.mean, same.low, same.high, same.clear) == (0, 0, 0, False)
    lone = difference([row_of("3dgs", 0, {"a": 1.0}), row_of("legs", 0, {"a": 2.0})], "legs", "3dgs")
    assert lone is not None and lone.mean == 1.0 and math.isnan(lone.low) and not lone.clear
    with pytest.raises(LegsError, match="other views"):
        difference([row_of("3dgs", 0, {"a": 1.0}), row_of("legs", 0, {"a": 1.0, "b": 2.0})], "legs", "3dgs")


def test_an_interval_covers_the_truth_as_often_as_it_says() -> None:
    """Of 60 samples of 40 views around a true gain of 0.3 dB: 95% of intervals hold it, so surely more than 48."""
    random = np.random.default_rng(0)
    held = 0
    for _ in range(60):
        plain = {f"{index}": 25.0 for index in range(40)}
        plain["a"] = 25.0
        gained = {view: value + random.normal(0.3, 0.5) for view, value in plain.items()}
        found = difference([row_of("3dgs", 0, plain), row_of("legs", 0, gained)], "legs", "3dgs")
        assert found is not None
        held += found.low <= 0.3 <= found.high
    assert 48 < held <= 60


def test_the_interval_of_one_seed_is_scipys_over_views() -> None:
    values = np.random.default_rng(1).normal(0.2, 1.0, 30)
    expected = bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", random_state=np.random.default_rng(2)
    ).confidence_interval
    assert interval([values[None]], 20_000) == pytest.approx((expected.low, expected.high), abs=0.02)


def test_the_interval_knows_how_seeds_and_views_scatter() -> None:
    """Of seeds' and views' effects that add up, the variance of a resampled mean is the sum of theirs, by formula."""
    random = np.random.default_rng(3)
    seeds, views = random.normal(0.0, 0.3, 12), random.normal(0.0, 0.5, 25)
    table = 1.0 + seeds[:, None] + views
    spread = math.sqrt(seeds.var() / len(seeds) + views.var() / len(views))
    low, high = interval([table])
    assert (low, high) == pytest.approx((table.mean() - 1.96 * spread, table.mean() + 1.96 * spread), abs=0.02)
    over_views = interval([table.mean(0)[None]])
    assert high - low > 1.2 * (over_views[1] - over_views[0])


def test_scenes_count_the_same_in_a_pooled_difference() -> None:
    large = [row_of("3dgs", 0, dict.fromkeys("abcdefgh", 20.0)), row_of("legs", 0, dict.fromkeys("abcdefgh", 21.0))]
    small = [row_of("3dgs", 0, dict.fromkeys("ab", 20.0)), row_of("legs", 0, dict.fromkeys("ab", 18.0))]
    found = pooled_difference([large, small], "legs", "3dgs")
    assert found == (-0.5, -0.5, -0.5, (-0.5,))
    assert pooled_difference([large, small[:1]], "legs", "3dgs") is None
    noisy = [np.random.default_rng(4).normal(0.0, 1.0, (1, 40)), np.random.default_rng(5).normal(0.0, 1.0, (1, 40))]
    alone, both = interval(noisy[:1]), interval(noisy)
    assert (both[1] - both[0]) / (alone[1] - alone[0]) == pytest.approx(0.5**0.5, abs=0.15)


def test_tables_by_hand() -> None:
    plain, better = {"a": 20.0, "b": 30.0}, {"a": 21.0, "b": 31.0}
    rows = [row_of("3dgs", seed, plain) for seed in (0, 1)]
    rows += [row_of("legs", 0, better, 200), row_of("legs", 1, better, 300)]
    summary = summarise(rows[2:])
    assert (summary.mean["train PSNR"], summary.mean["Gaussians"], summary.mean["ms an iteration"]) == (26, 250, 30)
    assert summary.spread["Gaussians"] == pytest.approx(70.7, abs=0.02)
    assert summarise([row_of("legs", 0, better)]).mean["strongest 10%"] == 21.0
    compiling = row_of("legs", 2, better)
    compiling["metrics"]["processor_seconds"] = 60.0
    assert summarise([compiling, *rows[2:]]).mean["ms an iteration"] == 30
    without = row_of("legs", 0, better)
    without["metrics"]["test"] = None  # nothing is held out
    assert math.isnan(summarise([without]).mean["held-out PSNR"])
    scores = markdown(*scores_table(rows, ["3dgs", "C3"]))
    assert "| C3 (legs) | 26.00 ± 0.00 |" in scores
    assert "250 ± 71" in scores
    older = row_of("eggs", 0, plain)  # than a metric
    for split in ("train", "test"):
        older["metrics"][split] = {"psnr": 25.0, "ssim": 0.5}
        older["metrics"]["views"][split] = {view: {"psnr": value, "ssim": 0.5} for view, value in plain.items()}
    heads, (cells,) = scores_table([older], ["eggs"])
    shown = dict(zip(heads, cells))
    assert [shown[f"{split} {score}"] for split in ("train", "held-out") for score in ("PSNR", "SSIM")] == [
        "25.00",
        "0.5000",
        "25.00",
        "0.5000",
    ]
    assert (shown["strongest 10%"], shown["the rest"]) == ("–", "–")
    assert difference([*rows, older], "eggs", "3dgs", "test", "psnr_strong") is None
    newer = row_of("eggs", 0, plain)
    assert "LPIPS" not in demo_table({"eggs": dict(newer["metrics"], seconds=1.0)})
    differences = markdown(*differences_table(rows, ["3dgs", "eggs", "legs-l", "legs"]))
    # Only over the seeds that both have.
    assert times_gaussians([*rows, row_of("3dgs", 2, plain, 900)], "legs", "3dgs") == 2.5
    assert times_gaussians(rows, "legs", "eggs") is None
    assert "legs − 3dgs" in differences and "+1.00 [+1.00, +1.00]" in differences and "2.50x" in differences
    assert len({len(line) for line in markdown(("a", "b"), (("x", "1"), ("long", "22"))).splitlines()}) == 1


def test_a_short_comparison_gives_no_differences() -> None:
    rows = [row_of(arm, seed, {"a": 20.0 + seed, "b": 21.0}) for arm in ("3dgs", "legs") for seed in range(2)]
    short = [{**row, "config": {"iterations": 499}} for row in rows]
    assert "Too short to decide: 499 iterations" in tables(short, ["3dgs", "legs"])
    long = tables([{**row, "config": {"iterations": 500}} for row in rows], ["3dgs", "legs"])
    assert "Too short" not in long and "legs − 3dgs" in long
