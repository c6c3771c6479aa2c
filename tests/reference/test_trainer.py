"""The trainer: its optimiser against torch's, density control by hand, scores against libraries, short runs."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, List, Optional

import numpy as np
import pytest
import torch

from legs_loss import PRESETS, LegsError, WeightSpec, legs_loss, ssim, weight_map
from legs_loss.cli import main
from legs_loss.cli import train as trainer_command
from legs_loss.precompute import precompute
from legs_loss.reference.gaussians import Gaussians
from legs_loss.reference.ply import read_ply
from legs_loss.reference.training import trainer
from legs_loss.reference.training.adam import COLOUR_RATE, FIELDS, RATES, Adam, position_rate
from legs_loss.reference.training.checkpoint import read_checkpoint, write_checkpoint
from legs_loss.reference.training.dataset import extent, load_dataset, load_view, split_views
from legs_loss.reference.training.densify import Schedule, densify, prunable
from legs_loss.reference.training.metrics import psnr, score, strongest
from legs_loss.reference.training.trainer import CHECKPOINT, TrainConfig, Weigh, default_threshold, train
from legs_loss.scenes import Scene, read_scene
from tests.support import without_times

pytest.importorskip("numba")


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """On a busy machine two threads can be many times slower than one."""
    trainer_command.set_threads(1)


SHORT = TrainConfig(iterations=60, seed=3)


@pytest.fixture(scope="module")
def scene(tiny_scene: Path) -> Scene:
    return read_scene(tiny_scene)


def gaussians_of(scales: List[List[float]], opacity: float = 0.5, sh: int = 4) -> Gaussians:
    count = len(scales)
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        log_scales=torch.tensor(scales).log(),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        opacity_logits=torch.full((count, 1), math.log(opacity / (1 - opacity))),
        sh=torch.randn(count, sh, 3),
    )


def assert_equal(first: Gaussians, second: Gaussians) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(first, name), getattr(second, name)), name


# Adam


def test_adam_is_torchs_adam_with_3dgs_rates() -> None:
    start = gaussians_of([[0.1, 0.2, 0.3]] * 400)
    ours = Adam(start)
    theirs = {name: getattr(start, name).clone() for name in ("means", *RATES)}
    theirs.update(dc=start.sh[:, :1].clone(), rest=start.sh[:, 1:].clone())
    rates = {**RATES, "means": 1.0, "dc": COLOUR_RATE, "rest": COLOUR_RATE / 20}
    groups = [{"params": [value.requires_grad_()], "lr": rates[name]} for name, value in theirs.items()]
    adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    for iteration in range(5):
        adam.param_groups[0]["lr"] = position_rate(iteration / 5, extent=2.0)
        for name in FIELDS:
            gradient = torch.randn_like(getattr(start, name)) * 10.0 ** -(iteration + 3)
            gradient[::7] = 0.0
            getattr(ours.gaussians, name).grad = gradient
            if name == "sh":
                theirs["dc"].grad, theirs["rest"].grad = gradient[:, :1].clone(), gradient[:, 1:].clone()
            else:
                theirs[name].grad = gradient.clone()
        ours.step(adam.param_groups[0]["lr"])
        adam.step()
    result = {name: getattr(ours.gaussians, name) for name in ("means", *RATES)}
    result.update(dc=ours.gaussians.sh[:, :1], rest=ours.gaussians.sh[:, 1:])
    for name, value in result.items():
        torch.testing.assert_close(value, theirs[name], rtol=1e-5, atol=1e-6, msg=name)
    assert torch.equal(ours.gaussians.means[0], start.means[0])  # never had a gradient: never moved


def test_moments_follow_their_gaussians() -> None:
    adam = Adam(gaussians_of([[1.0] * 3] * 3))
    for name in FIELDS:
        parameter = getattr(adam.gaussians, name)
        parameter.grad = torch.arange(3.0).reshape(3, *[1] * (parameter.dim() - 1)).expand_as(parameter).contiguous()
    adam.step(0.0)
    adam.replace(torch.tensor([2, 0]), gaussians_of([[2.0] * 3]))
    assert len(adam.gaussians) == 3
    torch.testing.assert_close(adam.moment1.means[:, 0], torch.tensor([0.2, 0.0, 0.0]))
    torch.testing.assert_close(adam.moment2.sh[:, 1, 1], torch.tensor([0.004, 0.0, 0.0]))
    assert all(getattr(adam.gaussians, name).requires_grad and getattr(adam.gaussians, name).is_leaf for name in FIELDS)


def test_an_opacity_reset_lowers_and_never_raises() -> None:
    adam = Adam(gaussians_of([[1.0] * 3] * 2))
    with torch.no_grad():
        adam.gaussians.opacity_logits[0] = -7.0
    adam.moment1.opacity_logits.fill_(1.0)
    adam.reset_opacity(0.01)
    torch.testing.assert_close(adam.gaussians.opacities[:, 0], torch.tensor([math.exp(-7) / (1 + math.exp(-7)), 0.01]))
    assert not adam.moment1.opacity_logits.any()


# Density control


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    """Extent 10: up to a scale of 0.1 a Gaussian is cloned. Below the threshold nothing happens."""
    before = gaussians_of([[0.05] * 3, [0.3, 0.01, 0.01], [0.3] * 3, [0.1, 0.1, 0.01]])
    gradient = torch.tensor([5e-4, 6e-4, 4.9e-4, 1.0])
    change = densify(before, gradient, 5e-4, 10.0, torch.Generator().manual_seed(0))
    assert change.kept.tolist() == [0, 2, 3]
    assert len(change.new) == 4
    for index, source in ((0, 0), (1, 3)):  # clones are equal to their sources
        for name in FIELDS:
            assert torch.equal(getattr(change.new, name)[index], getattr(before, name)[source])
    for index in (2, 3):  # children of number 1
        torch.testing.assert_close(change.new.scales[index], torch.tensor([0.3, 0.01, 0.01]) / 1.6)
        for name in ("quaternions", "opacity_logits", "sh"):
            assert torch.equal(getattr(change.new, name)[index], getattr(before, name)[1])
    assert not torch.equal(change.new.means[2], change.new.means[3])


def test_children_are_drawn_from_their_parent() -> None:
    """A needle along its own x axis, turned by 90 degrees about z: its children spread along y."""
    many = gaussians_of([[2.0, 0.5, 0.02]] * 4000)
    many.means.zero_()
    many.quaternions[:] = torch.tensor([3.0, 0.0, 0.0, 3.0])  # any length
    change = densify(many, torch.ones(4000), 0.5, 1.0, torch.Generator().manual_seed(0))
    assert len(change.kept) == 0
    assert len(change.new) == 8000
    torch.testing.assert_close(change.new.means.std(0), torch.tensor([0.5, 2.0, 0.02]), rtol=0.05, atol=0)
    torch.testing.assert_close(change.new.means.mean(0), torch.zeros(3), rtol=0, atol=0.1)


def test_a_cap_lets_the_largest_gradients_through() -> None:
    before = gaussians_of([[0.05] * 3, [0.3] * 3, [0.05] * 3, [0.05] * 3])
    gradient = torch.tensor([3.0, 2.0, 4.0, 1.0])
    for cap, kept, new in (
        (6, [0, 1, 2, 3], [2, 0]),
        (4, [0, 1, 2, 3], []),
        (2, [0, 1, 2, 3], []),
        (7, [0, 2, 3], None),
    ):
        change = densify(before, gradient, 0.5, 10.0, torch.Generator().manual_seed(0), cap)
        assert change.kept.tolist() == kept
        assert len(change.kept) + len(change.new) == max(cap, 4)
        if new is not None:
            assert sorted(change.new.means[:, 0].tolist()) == sorted(3.0 * index for index in new)


def test_transparent_ones_are_pruned_and_later_too_wide_ones() -> None:
    gaussians = gaussians_of([[0.5] * 3, [1.5, 0.1, 0.1], [0.5] * 3])
    gaussians.opacity_logits[2] = math.log(0.0049 / 0.9951)
    assert prunable(gaussians, 10.0, large_too=False).tolist() == [False, False, True]
    assert prunable(gaussians, 10.0, large_too=True).tolist() == [False, True, True]


def test_the_schedule_of_a_short_run() -> None:
    schedule = Schedule.of(400)
    assert [i for i in range(1, 401) if schedule.densifies(i)] == [60, 80, 100, 120, 140, 160, 180, 200, 220]
    assert not any(schedule.resets(i) for i in range(1, 401))
    assert [i for i in range(1, 30001) if Schedule.of(30000).resets(i)] == [3000, 6000, 9000, 12000]
    for iterations in (1, 2, 3, 10):
        Schedule.of(iterations)


# Scores


def test_scores_are_those_of_the_libraries() -> None:
    kornia, skimage = pytest.importorskip("kornia"), pytest.importorskip("skimage.metrics")
    target, prediction = torch.rand(3, 40, 50), torch.rand(3, 40, 50)
    assert psnr(prediction, target) == pytest.approx(float(kornia.metrics.psnr(prediction, target, 1.0)), abs=1e-4)
    ours = skimage.peak_signal_noise_ratio(target.numpy(), prediction.numpy(), data_range=1.0)
    assert score(prediction, target)["psnr"] == pytest.approx(ours, abs=1e-4)
    assert score(prediction, target)["ssim"] == pytest.approx(float(ssim(prediction, target)), abs=1e-5)
    assert psnr(target, target) == math.inf


def test_the_strongest_tenth_and_the_rest_make_the_whole() -> None:
    target, prediction = torch.rand(3, 40, 50), torch.rand(3, 40, 50) * 2 - 0.5  # to be clipped
    mask = strongest(target)
    assert int(mask.sum()) == 200
    scores = score(prediction, target)
    error = [10 ** (-scores[key] / 10) for key in ("psnr", "psnr_strong", "psnr_rest")]
    assert 0.1 * error[1] + 0.9 * error[2] == pytest.approx(error[0])
    assert int(strongest(torch.zeros(3, 40, 50)).sum()) == 200  # a constant image: still a tenth


# The data set


def test_every_eighth_view_is_held_out(scene: Scene) -> None:
    train_views, test_views = split_views(scene)
    assert [view.name for view in test_views] == ["images/table_000.png", "images/table_008.png"]
    assert len(train_views) == 10
    own = replace(
        scene, views=tuple(replace(v, split="test" if i == 1 else "train") for i, v in enumerate(scene.views))
    )
    assert [view.name for view in split_views(own)[1]] == ["images/table_001.png"]


def test_the_extent_is_3dgs_cameras_extent() -> None:
    class At:
        def __init__(self, x: float) -> None:
            pose = np.eye(4)
            pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
            pose[:3, 3] = -pose[:3, :3] @ [x, 5, 6]
            self.camera = type("C", (), {"world_to_camera": pose})

    assert extent([At(0.0), At(1.0), At(5.0)]) == pytest.approx(1.1 * 3)
    assert extent([At(2.0)]) == 1.0


def test_weights_come_from_the_store_only_for_the_very_image(scene: Scene, tmp_path: Path) -> None:
    precompute(scene, tmp_path)
    spec = PRESETS["legs"]
    computed = load_dataset(scene, spec)
    assert torch.equal(computed.train[0].weight, weight_map(computed.train[0].image, spec))
    assert computed.test[0].weight is None
    stored = load_dataset(scene, spec, store=tmp_path)
    assert not torch.equal(stored.train[0].weight, computed.train[0].weight)  # float16 on disk
    torch.testing.assert_close(stored.train[0].weight, computed.train[0].weight, rtol=2e-3, atol=0)
    # The store holds another photograph of this name: never used.
    views = list(scene.views)
    views[1] = replace(views[1], path=views[2].path)
    swapped = load_dataset(replace(scene, views=tuple(views)), spec, store=tmp_path)
    assert torch.equal(swapped.train[0].weight, weight_map(swapped.train[0].image, spec))
    assert load_dataset(scene, PRESETS["3dgs"], store=tmp_path).train[0].weight is None


def test_explicit_maps_are_taken_and_checked(scene: Scene) -> None:
    names = [view.name for view in split_views(scene)[0]]
    maps = {name: torch.full((1, 48, 64), 2.0) for name in names}
    loaded = load_dataset(scene, PRESETS["3dgs"], weights=maps)
    assert all(float(view.weight.mean()) == 2.0 for view in loaded.train)
    with pytest.raises(LegsError, match=r"table_001.*\[1, 2, 2\].*\[1, 48, 64\]"):
        load_dataset(scene, PRESETS["3dgs"], weights={**maps, names[0]: torch.ones(1, 2, 2)})
    del maps[names[3]]
    with pytest.raises(LegsError, match=names[3]):
        load_dataset(scene, PRESETS["3dgs"], weights=maps)


def test_a_gray_photograph_trains_as_rgb(scene: Scene, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "gray.png"
    Image.open(str(scene.views[0].path)).convert("L").save(str(path))
    view = load_view(scene, replace(scene.views[0], path=path))
    assert view.image.shape == (3, 48, 64)
    assert torch.equal(view.image[0], view.image[2])


def test_scenes_that_cannot_be_trained_on_say_why(scene: Scene) -> None:
    fisheye = replace(scene.views[1], camera=None, camera_model="OPENCV_FISHEYE")
    for broken, message in (
        (replace(scene, read_points=None), "no points to start from"),
        (replace(scene, views=(scene.views[0], fisheye)), "OPENCV_FISHEYE.*undistort"),
        (replace(scene, views=(scene.views[0], replace(fisheye, camera_model=None))), "has no camera"),
        (replace(scene, views=scene.views[:1]), "none is left to train on"),
    ):
        with pytest.raises(LegsError, match=message):
            train(broken, SHORT)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 0),
        ("sh_degree", 4),
        ("lambda_dssim", 1.5),
        ("l1_scale", -1.0),
        ("position_lr_max_steps", 0),
        ("densify_grad_threshold", 0.0),
        ("max_gaussians", 0),
        ("spec", "leg"),
    ],
)
def test_settings_out_of_range_are_named(name: str, value: Any) -> None:
    with pytest.raises(LegsError, match=repr(value)):
        TrainConfig(**{name: value})


def test_settings_survive_json() -> None:
    config = TrainConfig(spec=WeightSpec(p=float("inf"), curve="C5"), max_gaussians=7, densify_grad_threshold=1e-3)
    assert TrainConfig.from_dict(json.loads(json.dumps(config.as_dict()))) == config


def test_the_threshold_follows_the_size_of_the_photographs() -> None:
    def of(height: int, width: int) -> float:
        return default_threshold([type("V", (), {"image": torch.empty(3, height, width)})])

    assert of(321, 180) == pytest.approx(5e-4, rel=0.01)
    assert of(60, 80) == pytest.approx(0.12 / math.sqrt(4800))
    assert of(1066, 1600) == 2e-4


# Trainings


def test_training_learns_the_scene_and_repeats_bit_for_bit(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=200, seed=1)
    first = train(scene, config, out=tmp_path / "a")
    second = train(scene, config)
    assert_equal(first.gaussians, second.gaussians)
    one, two = (train(scene, replace(config, iterations=5, seed=seed)).gaussians for seed in (1, 2))
    assert not torch.equal(one.means, two.means)
    metrics = first.metrics
    before = train(scene, replace(config, iterations=1)).metrics
    assert metrics["train"]["psnr"] > before["train"]["psnr"] + 6
    assert metrics["test"]["psnr"] > before["test"]["psnr"] + 4
    assert metrics["gaussians"] == len(first.gaussians) > 1200  # it started from 900
    assert metrics["mean_weight"] > 2
    # What is on disk is what was returned.
    assert json.loads((tmp_path / "a" / "metrics.json").read_text()) == metrics
    assert TrainConfig.from_dict(json.loads((tmp_path / "a" / "cfg.json").read_text())) == config
    assert_equal(read_ply(tmp_path / "a" / "point_cloud" / "iteration_200" / "point_cloud.ply"), first.gaussians)


@pytest.mark.parametrize(("steps", "last"), [(None, 1.6e-6), (3, 1.6e-6), (30000, 1.6e-4 * 0.01 ** (6 / 30000))])
def test_the_rate_of_positions_falls_over_as_many_iterations_as_3dgs_would_take(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, steps: Optional[int], last: float
) -> None:
    rates: List[float] = []
    step = Adam.step

    def spy(adam: Adam, rate: float) -> None:
        rates.append(rate)
        step(adam, rate)

    monkeypatch.setattr(Adam, "step", spy)
    train(scene, TrainConfig(iterations=6, position_lr_max_steps=steps))
    whole = extent(load_dataset(scene, PRESETS["legs"]).train)
    assert rates[-1] == pytest.approx(whole * last, rel=1e-9)
    assert rates[0] == pytest.approx(whole * 1.6e-4 * 0.01 ** (1 / (steps or 6)), rel=1e-9)


def test_the_loss_is_legs_loss(scene: Scene) -> None:
    """The trainer's compiled loss, on its own rendering, against the package's own."""
    view = load_dataset(scene, PRESETS["legs"]).train[0]
    prediction = torch.rand(3, 48, 64, requires_grad=True)
    ours = trainer.step_loss(prediction, view.image, view.weight, 0.2)
    expected = legs_loss(prediction, view.image, "legs")
    assert float(ours.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)


def test_l1_scale_is_a_weight_of_that_value_everywhere(scene: Scene) -> None:
    config = replace(SHORT, spec="3dgs", iterations=20)
    names = [view.name for view in split_views(scene)[0]]
    scaled = train(scene, replace(config, l1_scale=2.5))
    weighted = train(scene, config, weights={name: torch.full((1, 48, 64), 2.5) for name in names})
    assert_equal(scaled.gaussians, weighted.gaussians)
    assert scaled.metrics["mean_weight"] == 2.5
    assert not torch.equal(scaled.gaussians.means, train(scene, config).gaussians.means)


def test_a_cap_holds_and_a_threshold_counts(scene: Scene) -> None:
    config = TrainConfig(iterations=120, densify_grad_threshold=5e-4)
    free = train(scene, config).metrics["gaussians"]
    assert free > 1100
    assert train(scene, replace(config, max_gaussians=1000)).metrics["gaussians"] <= 1000
    assert train(scene, replace(config, densify_grad_threshold=1.0)).metrics["gaussians"] <= 900


def test_the_numbers_of_another_run_can_be_taken(scene: Scene) -> None:
    plain, legs = replace(SHORT, spec="3dgs"), replace(SHORT, spec="legs")
    led = train(scene, plain)
    caps = {iteration: count for iteration, count in led.metrics["growth"]}
    # Its own numbers, met by a threshold that lets all through: the very same Gaussians.
    assert_equal(train(scene, replace(plain, densify_grad_threshold=1e-9), caps=caps).gaussians, led.gaussians)
    free = train(scene, legs).metrics["gaussians"]
    followed = train(scene, replace(legs, densify_grad_threshold=1e-9), caps=caps).metrics
    assert free > 1.2 * led.metrics["gaussians"]
    assert followed["gaussians"] == pytest.approx(led.metrics["gaussians"], rel=0.01)
    assert followed["growth"] == led.metrics["growth"]


def rising(views: List[Any], config: TrainConfig) -> Weigh:
    """A weight that depends on all that it may depend on."""
    return lambda index, done, rendering: 1 + done * (views[index].weight - 1) * rendering.mean()


def test_weights_may_change_during_a_run(scene: Scene, tmp_path: Path) -> None:
    told: List[Any] = []

    def constant(views: List[Any], config: TrainConfig) -> Weigh:
        def weigh(index: int, done: float, rendering: torch.Tensor) -> torch.Tensor:
            told.append((index, done, rendering.requires_grad))
            return views[index].weight

        return weigh

    maps = train(scene, SHORT)
    same = train(scene, SHORT, weighting=constant)
    assert_equal(same.gaussians, maps.gaussians)
    assert [done for _, done, _ in told] == [(i + 1) / 60 for i in range(60)]
    assert {index for index, _, _ in told} == set(range(10))
    assert not any(gradient for _, _, gradient in told)
    assert same.metrics["mean_weight"] == pytest.approx(maps.metrics["mean_weight"], rel=1e-6)
    whole = train(scene, SHORT, weighting=rising, evaluate_every=20)
    assert not torch.equal(whole.gaussians.means, maps.gaussians.means)
    assert 1.0 < whole.metrics["mean_weight"] < maps.metrics["mean_weight"]
    run_until_killed(scene, tmp_path, SHORT, 30, weighting=rising, evaluate_every=20)
    resumed = train(scene, SHORT, out=tmp_path, resume=True, weighting=rising, evaluate_every=20)
    assert_equal(resumed.gaussians, whole.gaussians)
    assert without_times(resumed.metrics) == without_times(whole.metrics)


def test_a_run_keeps_its_history_and_each_views_scores(scene: Scene) -> None:
    metrics = train(scene, SHORT, evaluate_every=20).metrics
    assert [point["iteration"] for point in metrics["history"]] == [20, 40, 60]
    last = metrics["history"][-1]
    assert last["gaussians"] == metrics["gaussians"]
    assert last["test_psnr"] == metrics["test"]["psnr"]
    for split in ("train", "test"):
        scores = [values["psnr"] for values in metrics["views"][split].values()]
        assert sum(scores) / len(scores) == metrics[split]["psnr"]
    assert list(metrics["views"]["test"]) == [view.name for view in split_views(scene)[1]]


def test_harmonics_wait_for_their_degree(scene: Scene) -> None:
    result = train(scene, replace(SHORT, iterations=29, sh_degree=3))  # one degree more every iteration // 30
    assert result.gaussians.sh.shape[1] == 16
    with_one = train(scene, replace(SHORT, iterations=60, sh_degree=1))  # degree 1 from the second iteration on
    assert with_one.gaussians.sh[:, 1:].abs().max() > 0


def test_a_long_run_resets_opacities_and_prunes_wide_gaussians(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    schedule = Schedule(densify_from=5, densify_until=60, densify_every=10, reset_every=20, sh_every=10)
    monkeypatch.setattr(trainer, "Schedule", type("S", (), {"of": staticmethod(lambda _: schedule)}))
    seen = []
    reset = Adam.reset_opacity
    monkeypatch.setattr(Adam, "reset_opacity", lambda self, value: (seen.append(self.steps), reset(self, value)))
    run = trainer._Run.begin(load_dataset(scene, PRESETS["3dgs"]), SHORT, scene)
    for _ in range(20):
        run.step()
    assert float(run.adam.gaussians.opacities.detach().max()) == pytest.approx(0.01)
    for _ in range(30):
        run.step()
    assert seen == [20, 40]
    assert float(run.adam.gaussians.scales.detach().max()) <= 0.1 * run.extent * 1.2  # pruned at 50, and one step since


# Interruptions


def run_until_killed(scene: Scene, out: Path, config: TrainConfig, at: int, **arguments: Any) -> None:
    class Killed(BaseException):
        pass

    def kill(progress: trainer.Progress) -> None:
        if progress.iteration >= at:
            raise Killed

    with pytest.raises(Killed):
        train(scene, config, out=out, checkpoint_every=20, on_progress=kill, **arguments)


@pytest.mark.parametrize("at", [10, 30, 50])  # before the first periodic checkpoint, in and after densification
def test_a_resumed_run_ends_bit_equal(scene: Scene, tmp_path: Path, at: int) -> None:
    whole = train(scene, SHORT)
    run_until_killed(scene, tmp_path, SHORT, at)
    assert not (tmp_path / "metrics.json").exists()
    resumed = train(scene, SHORT, out=tmp_path, resume=True)
    assert_equal(resumed.gaussians, whole.gaussians)
    again = train(scene, SHORT, out=tmp_path, resume=True)  # finished: nothing left to do
    assert_equal(again.gaussians, whole.gaussians)
    runs = (whole.metrics, resumed.metrics, again.metrics)
    times = [(metrics.pop("seconds"), metrics.pop("processor_seconds")) for metrics in runs]
    assert whole.metrics == resumed.metrics == again.metrics
    assert times[1] == times[2]


def test_a_run_of_before_a_setting_can_be_resumed(scene: Scene, tmp_path: Path) -> None:
    run_until_killed(scene, tmp_path, SHORT, 20)
    arrays, facts = read_checkpoint(tmp_path / CHECKPOINT)
    del facts["config"]["position_lr_max_steps"]
    write_checkpoint(tmp_path / CHECKPOINT, arrays, facts)
    resumed = train(scene, SHORT, out=tmp_path, resume=True)
    assert_equal(resumed.gaussians, train(scene, SHORT).gaussians)


def test_a_checkpoint_of_another_run_is_refused(scene: Scene, tmp_path: Path) -> None:
    train(scene, replace(SHORT, iterations=2), out=tmp_path)
    with pytest.raises(LegsError, match="other settings"):
        train(scene, SHORT, out=tmp_path, resume=True)
    fewer = replace(scene, views=scene.views[:8])
    with pytest.raises(LegsError, match="other views"):
        train(fewer, replace(SHORT, iterations=2), out=tmp_path, resume=True)
    with pytest.raises(LegsError, match="no such checkpoint"):
        train(scene, SHORT, out=tmp_path / "empty", resume=True)
    with pytest.raises(LegsError, match="without an output folder"):
        train(scene, SHORT, resume=True)


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    write_checkpoint(path, {"a": np.arange(400.0)}, {"iteration": 7})
    arrays, facts = read_checkpoint(path)
    assert arrays["a"][399] == 399
    assert facts == {"iteration": 7}
    good = path.read_bytes()
    for length in range(0, len(good), 37):
        path.write_bytes(good[:length])
        with pytest.raises(LegsError, match=r"c\.npz.*damaged"):
            read_checkpoint(path)


# The command


def command(*arguments: Any, **more: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments_of(*arguments), env=environment(), capture_output=True, text=True, **more)


def arguments_of(*arguments: Any) -> List[str]:
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def environment() -> dict:
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
    return dict(os.environ, PYTHONPATH=path, OMP_NUM_THREADS="1")


def test_legs_train(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    flags = ("--preset", "legs-l", "--iterations", 20, "-r", 2, "--seed", 5, "--threads", 1)
    done = command("train", tiny_scene, "--out", out, *flags)
    assert done.returncode == 0, done.stderr
    assert "held-out views: PSNR" in done.stdout
    assert "Gaussians" in done.stderr
    assert "PSNR" in done.stderr
    config = TrainConfig(spec="legs-l", iterations=20, resolution=2, seed=5)
    expected = train(read_scene(tiny_scene), config)
    assert_equal(read_ply(out / "point_cloud" / "iteration_20" / "point_cloud.ply"), expected.gaussians)

    again = command("train", tiny_scene, "--out", out)
    assert again.returncode == 2
    assert "already holds a run" in again.stderr
    other = command("train", tiny_scene, "--out", out, "--resume", "--iterations", 30)
    assert other.returncode == 2
    assert "another iterations" in other.stderr
    resumed = command("train", tiny_scene, "--out", out, "--resume", *flags)
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout == done.stdout


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_loads_agree(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    flags = ("--preset", "legs", "--iterations", 20, "-r", 2, "--threads", 1)
    clouds = []
    for name in ("compiles", "loads"):
        done = command("train", tiny_scene, "--out", tmp_path / name, *flags)
        assert done.returncode == 0, done.stderr
        clouds.append((tmp_path / name / "point_cloud" / "iteration_20" / "point_cloud.ply").read_bytes())
    assert list((tmp_path / "cache").rglob("*.nbi"))
    assert clouds[0] == clouds[1]


def mistaken(*arguments: str) -> Any:
    try:
        return main(arguments)
    except SystemExit as error:  # argparse's own
        return error.code


def test_mistakes_on_the_command_line(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for flags, message in (
        (("--preset", "leg"), "invalid choice"),
        (("--iterations", "0"), "iterations must be at least 1"),
        (("--resume",), "no such checkpoint"),
        (("-r", "-3"), "resolution must be"),
        (("--threads", "0"), "--threads must be between 1 and"),
        (("--checkpoint_every", "0"), "--checkpoint_every"),
        (("--store", str(tmp_path)), "no store"),
    ):
        assert mistaken("train", str(tiny_scene), "--out", str(tmp_path / "run"), *flags) == 2, flags
        assert message in capsys.readouterr().err
    assert mistaken("train", str(tmp_path / "nowhere")) == 2
    assert "no folder" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def wait_for(path: Path, process: subprocess.Popen[bytes], newer_than: Optional[float] = None) -> None:
    """Until the file is there (and has changed since)."""
    deadline = time.monotonic() + 120
    while not path.exists() or (newer_than is not None and path.stat().st_mtime_ns <= newer_than):
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_ctrl_c_and_kill_9_lose_nothing_that_matters(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    flags = ("--iterations", 400, "-r", 4, "--threads", 1, "--checkpoint_every", 20)
    whole = command("train", tiny_scene, "--out", tmp_path / "whole", *flags)
    assert whole.returncode == 0, whole.stderr

    process = subprocess.Popen(arguments_of("train", tiny_scene, "--out", out, *flags), env=environment())
    wait_for(out / CHECKPOINT, process)
    wait_for(out / CHECKPOINT, process, (out / CHECKPOINT).stat().st_mtime_ns)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    interrupted = read_checkpoint(out / CHECKPOINT)[1]["iteration"]
    assert 0 < interrupted < 400

    resume = ("train", tiny_scene, "--out", out, "--resume", "--threads", 1, "--checkpoint_every", 20)
    process = subprocess.Popen(arguments_of(*resume), env=environment())
    wait_for(out / CHECKPOINT, process, (out / CHECKPOINT).stat().st_mtime_ns)
    process.kill()
    process.wait(60)
    assert interrupted < read_checkpoint(out / CHECKPOINT)[1]["iteration"] < 400

    resumed = command(*resume)
    assert resumed.returncode == 0, resumed.stderr
    files = [path / "point_cloud" / "iteration_400" / "point_cloud.ply" for path in (tmp_path / "whole", out)]
    assert files[0].read_bytes() == files[1].read_bytes()


def test_missing_numba_is_one_clear_error(tiny_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "numba.py").write_text("raise ImportError('no numba here')\n")
    env = environment()
    env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), env["PYTHONPATH"]])
    failed = subprocess.run(
        arguments_of("train", tiny_scene, "--out", tmp_path / "run"), env=env, capture_output=True, text=True
    )
    assert failed.returncode == 2
    assert "pip install 'legs-loss[cpu]'" in failed.stderr
    assert "Traceback" not in failed.stderr


@pytest.mark.slow
def test_a_real_capture(fox: Path) -> None:
    """Plain 3DGS and LEGS on photographs: both learn, LEGS with more Gaussians and a better fit of strong responses."""
    scene = read_scene(fox)
    config = TrainConfig(spec="3dgs", iterations=500, resolution=90)
    plain, legs = (train(scene, replace(config, spec=spec)).metrics for spec in ("3dgs", "legs"))
    assert plain["train"]["psnr"] > 26
    assert plain["test"]["psnr"] > 25
    assert legs["gaussians"] > 1.3 * plain["gaussians"]
    assert legs["test"]["psnr_strong"] > plain["test"]["psnr_strong"]
