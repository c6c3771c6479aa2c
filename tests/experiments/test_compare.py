"""`legs compare`: arms by name, the proof of the baseline, rows that resume, statistics, and the command itself."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest
import torch

from legs_loss import PRESETS, LegsError, WeightSpec, weight_map
from legs_loss.cli import main
from legs_loss.experiments.arms import CHANGES, LOOSE, needed, parse_arm, parse_arms
from legs_loss.experiments.baseline import prove_unweighted
from legs_loss.experiments.statistics import difference, interval, pooled_difference, summarise, times_gaussians
from legs_loss.experiments.studies import STUDIES, these_arms
from legs_loss.experiments.tables import again_text, differences_table, markdown, paper_text, scores_table

pytest.importorskip("numba")
pytest.importorskip("scipy")

from scipy.stats import bootstrap
from skimage.metrics import structural_similarity

from legs_loss.experiments.losses import LOSSES
from legs_loss.experiments.running import Comparison, read_row, read_rows, train_again
from legs_loss.experiments.weighting import WEIGHTINGS, fading, growing, multiscale, shuffled
from legs_loss.reference.training import trainer
from legs_loss.reference.training.dataset import TrainingView, load_dataset
from legs_loss.reference.training.side_by_side import train_arm
from legs_loss.reference.training.trainer import CHECKPOINT, TrainConfig, by_error, train
from legs_loss.scenes import read_scene
from tests.support import without_times

BASE = TrainConfig(iterations=40, resolution=2)

# Arms


def test_names_of_arms() -> None:
    assert parse_arm("legs").spec == PRESETS["legs"]
    assert parse_arm("C4").spec == WeightSpec(curve="C4")
    assert parse_arm("beta=5").spec == WeightSpec(beta=5.0)
    assert parse_arm("operator=sobel,p=1,beta=2").spec == WeightSpec(operator="sobel", p=1.0, beta=2.0)
    assert parse_arm("legs:mean1").spec == replace(PRESETS["legs"], normalise="mean")
    arm = parse_arm("percentile=99,error=0.5:mean1:late:lambda=0.3@C1")
    assert (arm.name, arm.weighting, arm.at) == (
        "percentile=99,error=0.5:mean1:late:lambda=0.3@legs-l",
        "late",
        "legs-l",
    )
    assert arm.at == "legs-l"
    assert (arm.spec.error, arm.config(BASE, 1.0, 1.0).lambda_dssim) == (0.5, 0.3)
    # One training, one name, so that it is never run twice.
    assert [parse_arm(name).name for name in ("C1", "C3", "beta=10", "beta=0", "legs-l")] == [
        "legs-l",
        "legs",
        "legs",
        "3dgs",
        "legs-l",
    ]
    assert len(parse_arms(["C3", "legs", "beta=10"])) == 1
    assert [arm.name for arm in needed(parse_arms(["legs@3dgs", "eggs"]))] == ["3dgs", "legs@3dgs", "eggs"]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("legz", "legz"),
        ("beta=much", "beta must be a number"),
        ("beta=-1", "beta"),
        ("legs:louder", "no change is named 'louder'"),
        ("legs:lambda=2", "lambda must be a number in"),
        ("legs:lambda=0.2:lambda=0.3", "give lambda once"),
        ("legs:fading:shuffled", "one of"),
        ("legs:scale:mean1", "scale"),
        ("3dgs:shuffled", "no weights to change"),
        ("legs@legs@3dgs", "an @ of its own"),
        ("legs@", "no loss"),
    ],
)
def test_wrong_names_are_explained(name: str, says: str) -> None:
    with pytest.raises(LegsError, match=says):
        parse_arm(name)


def test_every_study_and_change_can_be_named() -> None:
    for study in STUDIES.values():
        folders = [arm.folder for arm in parse_arms(study.arms)]
        assert len(set(folders)) == len(folders) == len(study.arms)
        assert all(folder.replace("-", "").replace(".", "").isalnum() for folder in folders)
        for arm in [*study.against, *study.against.values()]:
            assert arm in study.arms
    for change in (name.replace("=X", "=0.3") for name in CHANGES):
        assert parse_arm(f"legs:{change}").changes == (change,)
    assert set(WEIGHTINGS) | set(LOSSES) <= set(CHANGES)


def test_a_users_arms_stand_beside_what_they_are_measured_against() -> None:
    study = these_arms(["C1", "beta=0", "3dgs@C3", "legs@3dgs", "C1"])
    assert study.arms == ("beta=0", "legs", "C1", "3dgs@C3", "legs@3dgs")
    assert study.reference("3dgs@legs") == "legs"
    assert study.reference("legs@3dgs") == "3dgs"
    assert study.reference("3dgs") is None


def test_the_settings_of_controls() -> None:
    base = replace(BASE, seed=4)
    scale = parse_arm("legs:scale").config(base, 1e-3, 2.5)
    assert (scale.weights, scale.l1_scale, scale.densify_grad_threshold) == (PRESETS["3dgs"], 2.5, 1e-3)
    threshold = parse_arm("legs:threshold").config(base, 1e-3, 2.5)
    assert (threshold.weights, threshold.l1_scale, threshold.densify_grad_threshold) == (PRESETS["legs"], 1, 2.5e-3)
    half = parse_arm("legs:mean1:half").config(base, 1e-3, 2.5)
    assert (half.weights.normalise, half.l1_scale, half.densify_grad_threshold) == ("mean", 0.5, 1e-3)
    assert parse_arm("3dgs:half@3dgs").config(base, 1e-3, 2.5).l1_scale == 0.5
    counted = parse_arm("legs@3dgs").config(base, 1e-3, 2.5)
    assert (counted.weights, counted.densify_grad_threshold, counted.seed) == (PRESETS["legs"], LOOSE * 1e-3, 4)


# Weights


def views_of(scene: Path, spec: WeightSpec) -> List[TrainingView]:
    return load_dataset(read_scene(scene), spec, 2).train


def test_shuffled_maps_have_the_same_weights_elsewhere(tiny_scene: Path) -> None:
    views = views_of(tiny_scene, PRESETS["legs"])
    weigh = shuffled(views, BASE)
    for index, view in enumerate(views):
        weight = weigh(index, 0.5, view.image)
        assert weight is not None and view.weight is not None
        assert torch.equal(weight.flatten().sort().values, view.weight.flatten().sort().values)
        correlation = np.corrcoef(weight.flatten().numpy(), view.weight.flatten().numpy())[0, 1]
        assert abs(correlation) < 0.2
    assert torch.equal(weigh(0, 0.1, views[0].image), shuffled(views, BASE)(0, 0.9, views[0].image))
    assert not torch.equal(
        weigh(0, 0.1, views[0].image), shuffled(views, replace(BASE, seed=1))(0, 0.1, views[0].image)
    )


def test_a_beta_that_grows_or_fades(tiny_scene: Path) -> None:
    views = views_of(tiny_scene, PRESETS["legs"])
    image = views[3].image
    half = weight_map(image, WeightSpec(beta=5.0))
    for made in (growing, fading):
        weigh = made(views, BASE)
        torch.testing.assert_close(weigh(3, 0.5, image), half)
        start, end = weigh(3, 0.0, image), weigh(3, 1.0, image)
        plain, full = (start, end) if made is growing else (end, start)
        torch.testing.assert_close(plain, torch.ones_like(half))
        torch.testing.assert_close(full, views[3].weight)
    mean1 = growing(views_of(tiny_scene, replace(PRESETS["legs"], normalise="mean")), BASE)
    assert float(mean1(3, 0.3, image).mean()) == pytest.approx(1, rel=1e-5)


def test_several_scales_see_what_one_does_not() -> None:
    """A broad bump beside a dot as high: at the photograph's own size it hardly responds."""
    rows, columns = torch.meshgrid(torch.arange(32.0), torch.arange(64.0), indexing="ij")
    image = torch.exp(-((rows - 20) ** 2 + (columns - 44) ** 2) / (2 * 3.0**2)).repeat(3, 1, 1)
    image[:, 4, 4] = 1.0
    view = TrainingView("a", None, image, None)  # type: ignore[arg-type]
    spec = WeightSpec(curve="C1")
    weight = multiscale([view], replace(BASE, spec=spec))(0, 0.0, image)
    assert weight is not None and weight.shape == (1, 32, 64)

    def share(weight: torch.Tensor) -> float:
        return float((weight[0, 20, 44] - 1) / (weight[0, 4, 4] - 1))

    assert share(weight_map(image, spec)) < 0.1
    assert share(weight) > 0.3


def test_weights_inside_ssim() -> None:
    image, rendering = torch.rand(3, 24, 20), torch.rand(3, 24, 20, requires_grad=True)
    weight = weight_map(image, WeightSpec())
    same = LOSSES["ssim"](rendering, image, torch.full_like(weight, 2.5), 0.2)
    torch.testing.assert_close(same, 2.5 * trainer.step_loss(rendering, image, None, 0.2))
    _, of_each = structural_similarity(  # skimage's map, an independent one; its border is another
        image.numpy(), rendering.detach().numpy(), channel_axis=0, data_range=1.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    inside = torch.zeros_like(weight)
    inside[:, 5:-5, 5:-5] = weight[:, 5:-5, 5:-5]
    expected = float((inside * (1 - torch.from_numpy(of_each))).mean())
    assert float(LOSSES["ssim"](rendering.detach(), image, inside, 1.0)) == pytest.approx(expected, rel=1e-4)


def test_weight_goes_where_the_rendering_errs() -> None:
    image = torch.rand(3, 24, 24)
    wrong = image.clone()
    wrong[:, 10:14, 10:14] += 0.3
    view = TrainingView("a", None, image, None)  # type: ignore[arg-type]
    config = replace(BASE, spec=WeightSpec(percentile=99.0, error=0.5, curve="C1"))
    weigh = by_error([view], config)
    assert WEIGHTINGS["late"]([view], config)(0, 0.3, wrong) is None
    assert torch.equal(WEIGHTINGS["late"]([view], config)(0, 0.4, wrong), weigh(0, 0.4, wrong))
    weight = weigh(0, 0.0, wrong)
    assert float(weight[0, 10:14, 10:14].mean()) > 3
    assert float(weight[0, :5].max()) == 1.0  # beyond the reach of the blur
    assert torch.equal(weigh(0, 0.0, image), torch.ones(1, 24, 24))  # nothing is wrong


# The baseline


def test_the_baseline_is_proven(tiny_scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain, legs = views_of(tiny_scene, PRESETS["3dgs"]), views_of(tiny_scene, PRESETS["legs"])
    config = replace(BASE, spec="3dgs")
    proof = prove_unweighted(plain, config)
    assert proof["views"] == len(plain)
    assert proof["loss"] == pytest.approx(proof["loss_3dgs"], rel=1e-5)
    assert proof["gradient_error"] < 1e-4
    with pytest.raises(LegsError, match=r"the baseline is weighted: images/.* mean [2-9]"):
        prove_unweighted(legs, config)
    with pytest.raises(LegsError, match="the baseline is weighted"):
        prove_unweighted(plain, replace(config, l1_scale=1.001))

    def patched(prediction: Any, target: Any, weight: Any, lambda_dssim: float) -> Any:
        """A loss that was patched where no map shows it."""
        return trainer_loss(prediction, target, weight_map(target, "legs-l"), lambda_dssim)

    trainer_loss = trainer.step_loss
    monkeypatch.setattr("legs_loss.experiments.baseline.step_loss", patched)
    with pytest.raises(LegsError, match="the baseline's loss is not 3DGS's"):
        prove_unweighted(plain, config)


# Rows


def test_rows_are_complete_and_can_be_run_alone(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    comparison = Comparison(tiny_scene, BASE, out)
    arms = parse_arms(["legs", "legs:shuffled", "legs@3dgs"])
    told: List[str] = []
    rows = comparison.train(arms, [0, 1], 2, lambda name, progress: told.append(name))
    assert sorted({(row["arm"], row["seed"]) for row in rows}) == sorted(
        (arm, seed) for arm in ("3dgs", "legs", "legs:shuffled", "legs@3dgs") for seed in (0, 1)
    )
    assert "legs@3dgs, seed 1" in told
    settings, read = read_rows(out)
    assert sorted(map(json.dumps, read)) == sorted(map(json.dumps, rows))
    assert settings["baseline"]["views"] == 10
    assert not list(out.rglob(CHECKPOINT))
    by_name = {(row["arm"], row["seed"]): row for row in rows}
    assert by_name["3dgs", 0]["metrics"]["mean_weight"] == 1.0
    for seed in (0, 1):
        plain, counted = by_name["3dgs", seed]["metrics"], by_name["legs@3dgs", seed]["metrics"]
        assert counted["gaussians"] == pytest.approx(plain["gaussians"], rel=0.01)
        assert counted["growth"] == plain["growth"]
    row = by_name["legs@3dgs", 1]
    assert row["versions"]["torch"] == torch.__version__
    # From its row alone, by the trainer and by the package.
    again = train(
        read_scene(tiny_scene),
        TrainConfig.from_dict(row["config"]),
        caps={iteration: count for iteration, count in row["caps"]},
        evaluate_every=4,
    ).metrics
    assert without_times(again) == without_times(row["metrics"])
    before = sorted(out.rglob("*"))
    path = out / "legs-shuffled" / "seed-1" / "row.json"
    now = train_again(path, None, lambda progress: None)
    assert without_times(now["metrics"]) == without_times(by_name["legs:shuffled", 1]["metrics"])
    assert again_text(read_row(path), now).endswith("The same to the last digit.")
    assert sorted(out.rglob("*")) == before
    now["versions"]["torch"], now["metrics"]["gaussians"] = "9.9", 1
    assert f"What differs: torch ({torch.__version__}, now 9.9)." in again_text(read_row(path), now)
    # Given again, nothing is trained.
    del told[:]
    assert comparison.train(arms, [0, 1], 2, lambda name, progress: told.append(name)) == rows
    assert not told


def test_an_interrupted_row_goes_on(tiny_scene: Path, tmp_path: Path) -> None:
    whole = Comparison(tiny_scene, BASE, tmp_path / "whole").train_one(parse_arm("legs:growing"), 0)
    out = tmp_path / "out"
    arm = parse_arm("legs:growing")
    begun = Comparison(tiny_scene, BASE, out)._training("a", arm, 0)

    class Killed(BaseException):
        pass

    def kill(progress: trainer.Progress) -> None:
        if progress.iteration == 20:
            raise Killed

    with pytest.raises(Killed):
        train_arm(begun, kill)
    assert (out / arm.folder / "seed-0" / CHECKPOINT).is_file()
    row = Comparison(tiny_scene, BASE, out).train_one(arm, 0)
    assert without_times(row["metrics"]) == without_times(whole["metrics"])


def test_a_baseline_is_proven_anew_when_a_comparison_goes_on(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Comparison(tiny_scene, BASE, tmp_path)
    plain = trainer.step_loss
    monkeypatch.setattr(
        "legs_loss.experiments.baseline.step_loss",
        lambda prediction, target, weight, share: plain(prediction, target, weight_map(target, "legs"), share),
    )
    with pytest.raises(LegsError, match="the baseline's loss is not 3DGS's"):
        Comparison(tiny_scene, BASE, tmp_path)


@pytest.mark.parametrize("damage", ["{", "{}", "[]", '{"arm": "legs", "seed": 0}'])
def test_damaged_files_are_named(damage: str, tiny_scene: Path, tmp_path: Path) -> None:
    comparison = Comparison(tiny_scene, BASE, tmp_path)
    plan = tmp_path / "3dgs" / "seed-0" / "plan.json"
    row = plan.with_name("row.json")
    plan.parent.mkdir(parents=True)
    plan.write_text(damage)
    with pytest.raises(LegsError, match=r"plan.json: this file is damaged"):
        comparison.train_one(parse_arm("3dgs"), 0)
    row.write_text(damage)
    for read in (lambda: comparison.row(parse_arm("3dgs"), 0), lambda: read_rows(tmp_path), lambda: read_row(row)):
        with pytest.raises(LegsError, match=r"row.json: this file is damaged"):
            read()
    with pytest.raises(LegsError, match="no row here"):
        read_row(tmp_path)
    (tmp_path / "comparison.json").write_text(damage)
    with pytest.raises(LegsError, match=r"comparison.json: this file is damaged"):
        Comparison(tiny_scene, BASE, tmp_path)


def test_where_nothing_can_be_written(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    settings = ["--iterations", "4", "-r", "2", "--seeds", "1", "--processes", "1"]
    for scene in ([str(tiny_scene)], []):  # its own scene is written there first
        assert main(["compare", *scene, *settings, "--out", str(tmp_path / "file")]) == 2
        assert capsys.readouterr().err.startswith(f"legs: error: cannot write {tmp_path / 'file'}")
    out = tmp_path / "out"
    out.mkdir()
    (out / "3dgs").write_text("")
    assert main(["compare", str(tiny_scene), *settings, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "cannot write" in error and "Traceback" not in error


def test_another_comparison_in_the_folder_is_refused(tiny_scene: Path, tmp_path: Path) -> None:
    Comparison(tiny_scene, BASE, tmp_path)
    with pytest.raises(LegsError, match=r"begun with another base.iterations"):
        Comparison(tiny_scene, replace(BASE, iterations=50), tmp_path)
    with pytest.raises(LegsError, match="takes its numbers from 3dgs: train that first"):
        Comparison(tiny_scene, BASE, tmp_path).train_one(parse_arm("legs@3dgs"), 0)
    with pytest.raises(LegsError, match="none of this comparison's rows is trained yet"):
        read_rows(tmp_path)
    with pytest.raises(LegsError, match="no comparison here"):
        read_rows(tmp_path / "elsewhere")
    (tmp_path / "comparison.json").write_text("{")
    with pytest.raises(LegsError, match="damaged"):
        Comparison(tiny_scene, BASE, tmp_path)


# Statistics


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
    scores = scores_table(rows, ["3dgs", "C3"])
    assert "| C3 (legs) | 26.00 ± 0.00 |" in scores
    assert "250 ± 71" in scores
    older = row_of("eggs", 0, plain)  # than a metric
    for split in ("train", "test"):
        older["metrics"][split] = {"psnr": 25.0, "ssim": 0.5}
        older["metrics"]["views"][split] = {view: {"psnr": value, "ssim": 0.5} for view, value in plain.items()}
    cells = [cell.strip() for cell in scores_table([older], ["eggs"]).splitlines()[-1].split("|")]
    assert cells[2:8] == ["25.00", "0.5000", "25.00", "0.5000", "–", "–"]
    assert difference([*rows, older], "eggs", "3dgs", "test", "psnr_strong") is None
    newer = row_of("eggs", 0, plain)
    for row in (older, newer):
        row["metrics"]["growth"], row["versions"] = [], {}
    newer["metrics"]["views"]["train"] = older["metrics"]["views"]["train"]
    for scores in newer["metrics"]["views"]["test"].values():
        scores["ssim"] = 0.5
    assert again_text(older, newer).endswith("The same to the last digit.")  # of the metrics that both have
    differences = differences_table(rows, STUDIES["main"])
    # Only over the seeds that both have.
    assert times_gaussians([*rows, row_of("3dgs", 2, plain, 900)], "legs", "3dgs") == 2.5
    assert times_gaussians(rows, "legs", "eggs") is None
    assert "legs − 3dgs" in differences and "+1.00 [+1.00, +1.00]" in differences and "2.50x" in differences
    assert len({len(line) for line in markdown(("a", "b"), (("x", "1"), ("long", "22"))).splitlines()}) == 1


def test_arms_that_should_not_differ_are_compared_in_pairs() -> None:
    study = STUDIES["noise"]
    assert all(parse_arm(arm).spec.beta < 1e-5 for arm in study.arms)
    plain = {"a": 20.0, "b": 30.0, "c": 25.0}
    rows = [row_of(parse_arm(arm).name, seed, plain) for arm in study.arms for seed in (0, 1)]
    for row in rows:
        if row["arm"] == "beta=2e-6":  # clear of all others, by 0.3 dB
            row["metrics"]["views"]["train"] = {
                view: {"psnr": value + gain} for (view, value), gain in zip(plain.items(), (0.2, 0.3, 0.4))
            }
    table = differences_table(rows, study)
    assert re.search(r"train PSNR +\| +0\.00 \| +0\.30 \| +6 of 21", table)
    assert re.search(r"held-out SSIM +\| +0\.0000 \| +0\.0000 \| +0 of 21", table)


def test_the_papers_order_is_compared() -> None:
    gains = {"3dgs": 0.0, "legs-l": 0.5, "C2": 0.1, "legs": 1.0, "C4": 0.2, "C5": 0.7}
    rows = [
        row_of(arm, seed, {view: 25 + gain + 0.01 * seed for view in "abc"})
        for arm, gain in gains.items()
        for seed in (0, 1)
    ]
    text = paper_text(rows, STUDIES["curves"])
    assert "Order in the paper: C3 > C5 > C1 > C4 > C2. Here: C3 > C5 > C1 > C4 > C2." in text
    assert "The orders agree." in text
    for row in rows:
        if row["arm"] == "C4":
            row["metrics"]["views"]["train"] = {view: {"psnr": 25.05} for view in "abc"}
    text = paper_text(rows, STUDIES["curves"])
    assert "Here: C3 > C5 > C1 > C2 > C4." in text
    assert "C4 − C2 is -0.06" in text
    assert "agree" not in text


# The command


def command(*arguments: Any) -> List[str]:
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def environment() -> Dict[str, str]:
    root = str(Path(__file__).resolve().parents[2])
    return dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])))


def test_the_command(tiny_scene: Path, tmp_path: Path) -> None:
    before = sorted(tiny_scene.rglob("*"))
    arguments = command("compare", tiny_scene, "--out", tmp_path / "out", "--iterations", 20, "-r", 2, "--seeds", 2)
    arguments += ["--processes", "2", "--arms", "legs", "legs@3dgs"]
    done = subprocess.run(arguments, env=environment(), capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert sorted(tiny_scene.rglob("*")) == before
    assert "The baseline is unweighted: over 10 views" in done.stdout
    assert "6 of 6 trainings to do" in done.stdout
    rows = read_rows(tmp_path / "out")[1]
    assert len(rows) == 6
    assert scores_table(rows, ["3dgs", "legs", "legs@3dgs"]) in done.stdout
    again = subprocess.run(arguments, env=environment(), capture_output=True, text=True, encoding="utf-8")
    assert again.returncode == 0
    assert "0 of 6 trainings to do" in again.stdout


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_ctrl_c_keeps_the_rows_that_are_done(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = command("compare", tiny_scene, "--out", out, "--iterations", 150, "-r", 1, "--processes", 1)
    process = subprocess.Popen(arguments, env=environment(), stderr=subprocess.PIPE, start_new_session=True)
    deadline = time.monotonic() + 240
    while not (out / "3dgs" / "seed-0" / "row.json").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    assert b"Traceback" not in stderr
    assert read_rows(out)[1][0]["arm"] == "3dgs"


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_killed_it_goes_on(tiny_scene: Path, tmp_path: Path) -> None:
    """Killed with no chance to clean up: its trainings end by themselves, in silence, and what is there is used."""
    out = tmp_path / "out"
    arguments = command("compare", tiny_scene, "--out", out, "--iterations", 150, "-r", 1, "--processes", 1)
    arguments += ["--seeds", "1", "--arms", "legs"]
    with open(str(tmp_path / "stderr"), "wb") as stderr:
        process = subprocess.Popen(arguments, env=environment(), stderr=stderr, start_new_session=True)
        deadline = time.monotonic() + 240
        while not (out / "legs" / "seed-0" / CHECKPOINT).exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.kill()
        process.wait()
    done = subprocess.run(arguments, env=environment(), capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "1 of 2 trainings to do" in done.stdout
    assert b"Traceback" not in (tmp_path / "stderr").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seeds", "0"], "--seeds must be at least 1"),
        (["--arms", "legs:louder"], "no change is named 'louder'"),
        (["--iterations", "0"], "iterations must be at least 1"),
        (["--first_seed", "-1"], "--first_seed must be at least 0"),
        (["--again", "row.json"], "row.json: there is no row here"),
    ],
)
def test_mistakes_on_the_command_line(
    arguments: List[str], says: str, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["compare", str(tiny_scene), "--out", str(tmp_path / "out"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("legs: error: ") and says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
