"""The arms of `legs compare`: their names, their weights by value, the proof of the baseline."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, List

import numpy as np
import pytest
import torch

from legs_loss import PRESETS, LegsError, WeightSpec, weight_map
from legs_loss.lab.experiments.arms import CHANGES, LOOSE, STUDIES, needed, parse_arm, parse_arms, these_arms
from legs_loss.lab.experiments.baseline import prove_unweighted
from legs_loss.weights import Weights

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_loss.lab.training import trainer
from legs_loss.lab.training.config import TrainConfig
from legs_loss.lab.training.dataset import TrainingView, load_dataset, shuffled
from legs_loss.scenes import read_scene
from tests.lab.experiments.support import BASE


def test_names_of_arms() -> None:
    assert parse_arm("legs").spec == PRESETS["legs"]
    assert parse_arm("C4").spec == WeightSpec(curve="C4")
    assert parse_arm("beta=5").spec == WeightSpec(beta=5.0)
    assert parse_arm("operator=sobel,p=1,beta=2").spec == WeightSpec(operator="sobel", p=1.0, beta=2.0)
    assert parse_arm("legs:mean1").spec == replace(PRESETS["legs"], normalise="mean")
    arm = parse_arm("percentile=99,smooth=0.5:mean1:shuffled:lambda=0.3@C1")
    assert (arm.name, arm.at) == ("percentile=99,smooth=0.5:mean1:shuffled:lambda=0.3@legs-l", "legs-l")
    config = arm.config(BASE, 1.0, 1.0)
    assert (arm.spec.smooth, config.lambda_dssim, config.shuffled) == (0.5, 0.3, True)
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


def test_weights_of_a_part_of_the_schedule() -> None:
    def weighted(name: str) -> List[int]:
        config = parse_arm(name).config(BASE, 1.0, 1.0)
        assert TrainConfig.from_dict(config.as_dict()) == config
        return [iteration for iteration in range(1, 6) if config.weighted(iteration)]

    assert weighted("legs") == [1, 2, 3, 4, 5]
    assert weighted("legs:until=2") == [1, 2]
    assert weighted("legs:from=2") == [3, 4, 5]
    assert weighted("legs:from=1:until=3") == [2, 3]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("legz", "legz"),
        ("beta=much", "beta must be a number"),
        ("beta=-1", "beta"),
        ("legs:louder", "no change is named 'louder'"),
        ("legs:lambda=2", "lambda must be a number in"),
        ("legs:lambda=0.2:lambda=0.3", "give lambda once"),
        ("legs:until=0", "until must be a whole number of at least 1, got '0'"),
        ("legs:from=2.5", "from must be a whole number"),
        ("3dgs:until=9", "no weights to change"),
        ("legs:until", "no change is named 'until'"),
        ("legs:shuffled:shuffled", "give each change once"),
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
    for names in STUDIES.values():
        folders = [arm.folder for arm in parse_arms(names)]
        assert len(set(folders)) == len(folders) == len(names)
        assert all(folder.replace("-", "").replace(".", "").isalnum() for folder in folders)
    for change in (name.replace("=X", "=0.3").replace("=N", "=9") for name in CHANGES):
        assert parse_arm(f"legs:{change}").changes == (change,)


def test_a_users_arms_stand_beside_what_they_are_measured_against() -> None:
    names = these_arms(["C1", "beta=0", "3dgs@C3", "legs@3dgs", "C1"])
    assert names == ["beta=0", "legs", "C1", "3dgs@C3", "legs@3dgs"]
    assert [parse_arm(name).reference for name in names] == [None, "3dgs", "3dgs", "legs", "3dgs"]


def test_the_settings_of_controls() -> None:
    base = replace(BASE, seed=4)
    scale = parse_arm("legs:scale").config(base, 1e-3, 2.5)
    assert (scale.weights, scale.l1_scale, scale.densify_grad_threshold) == (PRESETS["3dgs"], 2.5, 1e-3)
    threshold = parse_arm("legs:threshold").config(base, 1e-3, 2.5)
    assert (threshold.weights, threshold.l1_scale, threshold.densify_grad_threshold) == (PRESETS["legs"], 1, 2.5e-3)
    counted = parse_arm("legs@3dgs").config(base, 1e-3, 2.5)
    assert (counted.weights, counted.densify_grad_threshold, counted.seed) == (PRESETS["legs"], LOOSE * 1e-3, 4)


def views_of(scene: Path, spec: WeightSpec) -> List[TrainingView]:
    return load_dataset(read_scene(scene), spec, 2).train


def test_shuffled_maps_have_the_same_weights_elsewhere(tiny_scene: Path) -> None:
    views = views_of(tiny_scene, PRESETS["legs"])
    for shuffle, view in zip(shuffled(views, 0), views):
        weight = shuffle.weight
        assert weight is not None and view.weight is not None
        assert torch.equal(weight.flatten().sort().values, view.weight.flatten().sort().values)
        correlation = np.corrcoef(weight.flatten().numpy(), view.weight.flatten().numpy())[0, 1]
        assert abs(correlation) < 0.2
    first, again, other = (shuffled(views, seed)[0].weight for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


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
        return trainer_loss(prediction, target, Weights(map=weight_map(target, "legs-l")), lambda_dssim)

    trainer_loss = trainer.step_loss
    monkeypatch.setattr("legs_loss.lab.experiments.baseline.step_loss", patched)
    with pytest.raises(LegsError, match="the baseline's loss is not 3DGS's"):
        prove_unweighted(plain, config)
