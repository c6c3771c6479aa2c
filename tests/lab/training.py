"""Short trainings on the embedded scene: their settings, and how results are compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from legs_loss.lab.experiments.arms import ArmSpec
from legs_loss.lab.experiments.running import Comparison, Row
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.training import trainer
from legs_loss.lab.training.adam import FIELDS
from legs_loss.lab.training.side_by_side import train_arm
from legs_loss.lab.training.trainer import TrainConfig, train
from legs_loss.scenes import Scene

SHORT = TrainConfig(iterations=60, seed=3)


def train_one(comparison: Comparison, arm: ArmSpec, seed: int) -> Row:
    """Train one row of a comparison in this process, unless it exists; the row whose numbers it uses must exist."""
    if comparison.row(arm, seed) is None:
        metrics = train_arm(comparison._training(arm.name, arm, seed), lambda progress: None)
        comparison._finish(arm, seed, metrics)
    row = comparison.row(arm, seed)
    assert row is not None
    return row


def assert_equal(first: Gaussians, second: Gaussians) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def run_until_killed(scene: Scene, out: Path, config: TrainConfig, at: int, **arguments: Any) -> None:
    class Killed(BaseException):
        pass

    def kill(progress: trainer.Progress) -> None:
        if progress.iteration >= at:
            raise Killed

    with pytest.raises(Killed):
        train(scene, config, out=out, checkpoint_every=20, on_progress=kill, **arguments)
