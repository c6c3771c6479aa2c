"""`legs demo`: the main job on tiny inputs, as a real process; its trainings side by side; its table and pictures."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest
import torch

from legs_loss import LegsError
from legs_loss.lab.commands.demo import METHODS, conclusion, table
from legs_loss.lab.ply import read_ply
from legs_loss.lab.report.comparison import Compared, save_pictures
from legs_loss.lab.training.side_by_side import Arm, train_side_by_side
from legs_loss.lab.training.trainer import Progress, TrainConfig, train
from legs_loss.scenes import read_scene
from tests.support import without_times

pytest.importorskip("numba")
pytest.importorskip("matplotlib")


def command(*arguments: Any) -> List[str]:
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def environment() -> Dict[str, str]:
    root = str(Path(__file__).resolve().parents[3])
    return dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])))


@pytest.mark.slow
def test_the_demo_on_a_users_scene(tiny_scene: Path, tmp_path: Path) -> None:
    before = sorted(tiny_scene.rglob("*"))
    out = tmp_path / "demo"
    arguments = command("demo", tiny_scene, "--out", out, "--iterations", 30, "--processes", 2, "-r", 2)
    done = subprocess.run(arguments, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(tiny_scene.rglob("*")) == before  # nothing is written to a user's scene
    results = json.loads((out / "results.json").read_text())
    assert list(results) == list(METHODS)
    assert results["3dgs"]["mean_weight"] == 1.0 < results["legs-l"]["mean_weight"] < results["legs"]["mean_weight"]
    assert table(results) in done.stdout
    assert conclusion(results) in done.stdout
    for name in METHODS:
        gaussians = read_ply(out / name / "point_cloud" / "iteration_30" / "point_cloud.ply")
        assert len(gaussians) == results[name]["gaussians"]
        for kind in ("rendering", "error", "weight"):
            assert size_of(out / "pictures" / f"{name}-{kind}.png") == (32, 24)
    assert str(out / "pictures" / "comparison.png") in done.stdout
    assert f"in the browser: legs view {out} -s {tiny_scene} (it needs viser: pip install viser)\n" in done.stdout


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
@pytest.mark.slow
def test_ctrl_c_ends_the_demo_and_its_processes(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    process = subprocess.Popen(
        command("demo", tiny_scene, "--out", out, "--iterations", 100000, "--processes", 2),
        env=environment(),
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not (out / "legs" / "checkpoint.npz").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)  # to the parent alone
    stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    assert b"Traceback" not in stderr
    left = 100  # tenths of a second for the last of its session to go
    while is_alive(process.pid) and left:
        time.sleep(0.1)
        left -= 1
    assert left


def is_alive(session: int) -> bool:
    try:
        os.killpg(session, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_demo_that_cannot_be_says_so_at_once(tmp_path: Path) -> None:
    (tmp_path / "matplotlib.py").write_text("raise ImportError('none here')\n")
    env = environment()
    env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), env["PYTHONPATH"]])
    failed = subprocess.run(command("demo", "--out", tmp_path / "out"), env=env, capture_output=True, text=True)
    assert failed.returncode == 2
    assert "pip install matplotlib, or" in failed.stderr
    assert not (tmp_path / "out").exists()


def test_side_by_side_equals_one_after_the_other(tiny_scene: Path, tmp_path: Path) -> None:
    arms = [
        Arm(name, tiny_scene, TrainConfig(spec=name, iterations=20, resolution=2), tmp_path / name)
        for name in ("3dgs", "legs")
    ]
    told: List[str] = []
    metrics = train_side_by_side(arms, 2, lambda name, progress: told.append(f"{name} {progress.iteration}"))
    assert list(metrics) == ["3dgs", "legs"]
    assert sorted(told) == ["3dgs 10", "3dgs 20", "legs 10", "legs 20"]
    for arm in arms:
        alone = train(read_scene(tiny_scene), arm.config).metrics
        assert without_times(metrics[arm.name]) == without_times(alone)


@pytest.mark.slow
def test_one_failure_ends_them_all_and_is_named(tiny_scene: Path, tmp_path: Path) -> None:
    long = Arm("long", tiny_scene, TrainConfig(iterations=100000), tmp_path / "long")
    broken = Arm("broken", tmp_path / "nowhere", TrainConfig(), tmp_path / "broken")
    with pytest.raises(LegsError, match=r"broken: .*nowhere"):
        train_side_by_side([long, broken], 2, lambda name, progress: None)
    killed = Arm("killed", tiny_scene, TrainConfig(iterations=100000), tmp_path / "killed")

    def kill(name: str, progress: Progress) -> None:
        import multiprocessing

        for process in multiprocessing.active_children():
            process.kill()

    with pytest.raises(LegsError, match=r"killed: its process was killed"):
        train_side_by_side([killed], 1, kill)


def test_pictures_show_what_they_say(tmp_path: Path) -> None:
    photograph = torch.zeros(3, 30, 40)
    photograph[:, 10:20, 10:20] = 1.0
    wrong = photograph.clone()
    wrong[:, 5, 7] += 0.5
    weight = torch.ones(1, 30, 40)
    weight[0, 3, 4] = 11.0
    arms = [Compared("a", photograph * 2 - 0.5, weight, "first"), Compared("b", wrong, torch.ones(1, 30, 40), "second")]
    sheet = save_pictures(tmp_path, "title", photograph, arms)
    assert size_of(sheet)[0] > 800
    np.testing.assert_array_equal(pixels(tmp_path / "photograph.png"), photograph.permute(1, 2, 0).numpy() * 255)
    np.testing.assert_array_equal(pixels(tmp_path / "a-rendering.png"), photograph.permute(1, 2, 0).numpy() * 255)
    assert not pixels(tmp_path / "a-error.png")[..., 0].max() > 5  # clipped, the rendering is the photograph
    error = pixels(tmp_path / "b-error.png").astype(int).sum(2)
    assert np.argwhere(error > error.min()).tolist() == [[5, 7]]
    assert np.argwhere(pixels(tmp_path / "a-weight.png")[..., 1] > 200).tolist() == [[3, 4]]
    assert len(np.unique(pixels(tmp_path / "b-weight.png").reshape(-1, 3), axis=0)) == 1


def pixels(path: Path) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(str(path)))


def size_of(path: Path) -> tuple[int, int]:
    from PIL import Image

    return Image.open(str(path)).size
