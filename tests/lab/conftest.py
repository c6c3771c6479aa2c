"""Fixtures of the tests of the trainer: the embedded scene, and one thread."""

from __future__ import annotations

from pathlib import Path

import pytest

from legs_loss.scenes import Scene, read_scene


@pytest.fixture
def one_thread() -> None:
    """On a busy machine two threads can be many times slower than one."""
    from legs_loss.lab.commands import train as trainer_command

    trainer_command.set_threads(1)


@pytest.fixture(scope="module")
def scene(tiny_scene: Path) -> Scene:
    return read_scene(tiny_scene)
