"""The trainer: scores against libraries, its data set, its settings, short trainings."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, List, Optional

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss import PRESETS, LegsError, WeightSpec, d_ssim, legs_loss, ssim, weight_map
from legs_loss.lab.ply import read_ply
from legs_loss.lab.training import trainer
from legs_loss.lab.training.adam import Adam
from legs_loss.lab.training.dataset import extent, load_dataset, load_view, split_views
from legs_loss.lab.training.densify import Schedule
from legs_loss.lab.training.metrics import psnr, score, strongest
from legs_loss.lab.training.trainer import TrainConfig, default_threshold, train
from legs_loss.precompute import UserMaps, precompute
from legs_loss.scenes import Scene, read_scene
from legs_loss.weights import Weights
from tests.lab.training import SHORT, assert_equal

pytest.importorskip("numba")


pytestmark = pytest.mark.usefixtures("one_thread")


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
    torch.testing.assert_close(swapped.train[0].weight, weight_map(swapped.train[0].image, spec), rtol=2e-3, atol=0)
    assert load_dataset(scene, PRESETS["3dgs"], store=tmp_path).train[0].weight is None


def test_photographs_that_are_enlarged_are_said(scene: Scene, capsys: pytest.CaptureFixture[str]) -> None:
    load_dataset(scene, PRESETS["3dgs"], 64)
    assert capsys.readouterr().err == ""
    assert load_dataset(scene, PRESETS["3dgs"], 80).train[0].camera.width == 80
    said = "legs-loss: warning: the photographs are 64 wide, and -r enlarges them to 80\n"
    assert capsys.readouterr().err == said


def with_masks(scene: Scene, folder: Path, kind: str = "masks") -> Path:
    """Make a store in which the left quarter of each view but the last is left out, or weighs 0 of 1."""
    (folder / kind).mkdir()
    for view in scene.views[:-1]:
        mask = Image.new("L", (64, 48), 255)
        mask.paste(0, (0, 0, 16, 48))
        mask.save(str(folder / kind / f"{PurePosixPath(view.name).stem}.png"))
    precompute(scene, folder / "store", maps=UserMaps(**{kind: str(folder / kind)}))
    return folder / "store"


@pytest.mark.parametrize("preset", ["legs", "3dgs"])
def test_masked_pixels_get_no_gradient_and_do_not_dilute(scene: Scene, tmp_path: Path, preset: str) -> None:
    config = replace(SHORT, spec=preset)
    data = load_dataset(scene, config.weights, store=with_masks(scene, tmp_path))
    view = data.train[0]
    assert data.test[0].mask is not None and data.train[-1].mask is None  # the scene's last view
    torch.manual_seed(0)
    prediction = torch.rand(3, 48, 64, requires_grad=True)
    loss = trainer.step_loss(prediction, view.image, trainer.step_weights(view.weight, view, config), 0.2)
    loss.backward()
    assert prediction.grad is not None
    assert not prediction.grad[:, :, :16].any() and prediction.grad[:, :, 16:].all()
    seen = prediction.detach().clone()
    seen[:, :, :16] = view.image[:, :, :16]
    weights = weight_map(view.image, config.weights)[0, :, 16:].double()  # the mean over what counts, by hand
    l1 = (weights * (prediction.detach() - view.image).double().abs().mean(0)[:, 16:]).mean()
    structural = float(d_ssim(seen, view.image)) / 0.75
    assert float(loss.detach()) == pytest.approx(0.8 * float(l1) + 0.2 * structural, rel=2e-3)


def test_scores_leave_masked_pixels_out(scene: Scene, tmp_path: Path) -> None:
    view = load_dataset(scene, PRESETS["legs"], store=with_masks(scene, tmp_path)).test[0]
    assert view.counts is not None
    rendering = (view.image + 0.1).clamp(0, 1)
    rendering[:, :, :16] = 0.0  # a person who is gone
    scores = score(view.hidden(rendering), view.image, "test", view.counts)
    error = float((rendering - view.image)[:, :, 16:].double().square().mean())
    assert scores["psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)
    other = rendering.clone()
    other[:, :, :16] = 1.0
    assert score(view.hidden(other), view.image, "test", view.counts) == scores


def test_without_masks_a_step_is_what_it_was(scene: Scene) -> None:
    view = load_dataset(scene, PRESETS["legs"]).train[0]
    rendering = torch.rand(3, 48, 64)
    assert view.hidden(rendering) is rendering and view.counts is None
    assert trainer.step_weights(view.weight, view, SHORT).map is view.weight


def test_a_training_with_masks_and_weights_and_one_whose_photographs_the_store_does_not_know(
    scene: Scene, tmp_path: Path
) -> None:
    for kind in ("masks", "weights"):
        (tmp_path / kind).mkdir()
        store = with_masks(scene, tmp_path / kind, kind)
        result = train(scene, replace(SHORT, iterations=12), store=store)
        assert result.metrics.get("masked_views") == (len(scene.views) * 7 // 8 - 1 if kind == "masks" else None)
        with pytest.raises(LegsError, match=r"does not know .* of 32x24: give legs precompute the training's -r"):
            load_dataset(scene, PRESETS["legs"], 2, store=store)


def test_a_gray_photograph_trains_as_rgb(scene: Scene, tmp_path: Path) -> None:
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

    def spy(adam: Adam, rate: float, seen: Optional[torch.Tensor] = None) -> None:
        if rate:  # 0 is that of the step which is only to be compiled
            rates.append(rate)
        step(adam, rate, seen)

    monkeypatch.setattr(Adam, "step", spy)
    train(scene, TrainConfig(iterations=6, position_lr_max_steps=steps))
    whole = extent(load_dataset(scene, PRESETS["legs"]).train)
    assert rates[-1] == pytest.approx(whole * last, rel=1e-9)
    assert rates[0] == pytest.approx(whole * 1.6e-4 * 0.01 ** (1 / (steps or 6)), rel=1e-9)


def test_the_loss_is_legs_loss(scene: Scene) -> None:
    """The trainer's compiled loss, on its own rendering, against the package's own."""
    view = load_dataset(scene, PRESETS["legs"]).train[0]
    prediction = torch.rand(3, 48, 64, requires_grad=True)
    ours = trainer.step_loss(prediction, view.image, Weights(map=view.weight), 0.2)
    expected = legs_loss(prediction, view.image, "legs")
    assert float(ours.detach()) == pytest.approx(float(expected.detach()), rel=1e-5)


def test_l1_scale_is_a_weight_of_that_value_everywhere(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(SHORT, spec="3dgs", iterations=20)
    plain, scaled = train(scene, config), train(scene, replace(config, l1_scale=2.5))
    data = load_dataset(scene, PRESETS["3dgs"])
    constant = [replace(view, weight=torch.full((1, 48, 64), 2.5)) for view in data.train]
    monkeypatch.setattr(trainer, "load_dataset", lambda *given: data._replace(train=constant))
    assert_equal(scaled.gaussians, train(scene, config).gaussians)
    assert scaled.metrics["mean_weight"] == 2.5
    assert not torch.equal(scaled.gaussians.means, plain.gaussians.means)


def test_sparse_adam_is_an_option_that_changes_the_result(scene: Scene) -> None:
    sparse = train(scene, replace(SHORT, iterations=20, sparse_adam=True))
    dense = train(scene, replace(SHORT, iterations=20))
    assert not torch.equal(sparse.gaussians.means, dense.gaussians.means)  # what left a view coasts on in one of them
    assert sparse.metrics["train"]["psnr"] == pytest.approx(dense.metrics["train"]["psnr"], abs=1.0)
    assert "sparse_adam" not in SHORT.as_dict() and replace(SHORT, sparse_adam=True).as_dict()["sparse_adam"] is True


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
    monkeypatch.setattr(trainer, "Schedule", type("S", (), {"of_run": staticmethod(lambda _: schedule)}))
    seen = []
    reset = Adam.reset_opacity
    monkeypatch.setattr(Adam, "reset_opacity", lambda self, value: (seen.append(self.steps), reset(self, value)))
    run = trainer._TrainingState.begin(load_dataset(scene, PRESETS["3dgs"]), SHORT, scene)
    for _ in range(20):
        run.step()
    assert float(run.adam.gaussians.opacities.detach().max()) == pytest.approx(0.01)
    for _ in range(30):
        run.step()
    assert seen == [20, 40]
    assert float(run.adam.gaussians.scales.detach().max()) <= 0.1 * run.extent * 1.2  # pruned at 50, and one step since


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


def test_a_run_may_stop_at_a_milestone_and_go_on(scene: Scene, tmp_path: Path) -> None:
    whole = train(scene, SHORT)
    part = train(scene, SHORT, out=tmp_path, stop=29)
    assert part.metrics["iterations"] == 29
    assert not list(tmp_path.rglob("*.ply"))
    rest = train(scene, SHORT, out=tmp_path, resume=True)
    assert_equal(rest.gaussians, whole.gaussians)
