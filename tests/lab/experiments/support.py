"""The settings of short comparisons."""

from __future__ import annotations

import pytest

pytest.importorskip("numba")
pytest.importorskip("scipy")


from legs_loss.lab.training.trainer import TrainConfig

BASE = TrainConfig(iterations=40, resolution=2)
