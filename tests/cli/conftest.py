"""Fixtures of the tests of the commands."""

from __future__ import annotations

import pytest

from legs_loss.precompute import precompute
from legs_loss.scenes import read_scene
from tests.support import colmap_scene


@pytest.fixture
def scene(tmp_path):
    return colmap_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(6)])


@pytest.fixture
def store(scene):
    return precompute(read_scene(scene)).store
