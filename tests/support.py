"""Scenes on disk and the real command line, for tests that use them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from legs_loss.lab.embedded.colmap_writer import write_colmap
from legs_loss.runtime import state
from legs_loss.scenes import Camera, PointCloud
from tests.preloaded import PATH, run

ROOT = Path(__file__).resolve().parents[1]


def photograph(width, height, seed=0, channels=3):
    """Return uint8 noise on a ramp, [H, W, C]: no two pixels alike enough to hide a shift."""
    ramp = np.linspace(0, 120, width)[None, :, None]
    noise = np.random.RandomState(seed).randint(0, 135, (height, width, channels))
    return (ramp + noise).astype(np.uint8)


def save(path, pixels, **options):
    """Save pixels [H, W, C] as an image and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.squeeze(-1) if pixels.shape[-1] == 1 else pixels).save(str(path), **options)
    return path


def colmap_scene(root, names=("0001.png", "0002.png", "0003.png"), width=40, height=30):
    """Write a COLMAP scene of PINHOLE cameras with photographs and return its folder."""
    for seed, name in enumerate(names):
        save(root / "images" / name, photograph(width, height, seed))
    camera = Camera(width, height, 50.0, 51.0, width / 2, height / 2, np.eye(4))
    points = PointCloud(np.zeros((2, 3), np.float32), np.full((2, 3), 7, np.uint8))
    write_colmap(root, {name: camera for name in names}, points)
    return root


def legs_command(*arguments):
    """Return the command line of ``legs`` with these arguments."""
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def legs_environment():
    """Return an environment in which the child imports the same package as the tests."""
    return dict(os.environ, OMP_NUM_THREADS="1", PYTHONPATH=PATH)


def legs(*arguments, **options):
    """Run ``legs`` in a process of its own and return the completed process, with text output."""
    return run(legs_command(*arguments), **{"cwd": str(ROOT), "env": legs_environment(), "timeout": 900, **options})


def without_times(metrics):
    """Return a run's metrics without those that differ from run to run."""
    return {name: value for name, value in metrics.items() if not name.endswith("seconds")}


def start_run(monkeypatch, folder):
    """Begin a training run of its own: no settings from outside, started in an empty folder."""
    for name in [name for name in os.environ if name.startswith("LEGS_")]:
        monkeypatch.delenv(name)
    state.reset()
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.chdir(folder)
