"""Short trainings on the embedded scene: their settings, and how results are compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.training import trainer
from legs_loss.lab.training.adam import FIELDS
from legs_loss.lab.training.trainer import TrainConfig, train
from legs_loss.scenes import Scene

SHORT = TrainConfig(iterations=60, seed=3)


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
