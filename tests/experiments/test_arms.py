"""The arms of `legs compare`: their names, their weights by value, the proof of the baseline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, List

import numpy as np
import pytest
import torch

from legs_loss import PRESETS, LegsError, WeightSpec, weight_map
from legs_loss.experiments.arms import CHANGES, LOOSE, needed, parse_arm, parse_arms
from legs_loss.experiments.baseline import prove_unweighted
from legs_loss.experiments.studies import STUDIES, these_arms

pytest.importorskip("numba")
pytest.importorskip("scipy")

from skimage.metrics import structural_similarity

from legs_loss.experiments.losses import LOSSES
from legs_loss.experiments.weighting import WEIGHTINGS, fading, growing, multiscale, shuffled
from legs_loss.reference.training import trainer
from legs_loss.reference.training.dataset import TrainingView, load_dataset
from legs_loss.reference.training.trainer import by_error
from legs_loss.scenes import read_scene
from tests.experiments.support import BASE


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
        ("legs@legs@3dgs", "must not contain an @"),
        ("legs@", "is not a loss"),
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
