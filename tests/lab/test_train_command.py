"""`legs train`: the command, runs that are interrupted and resumed, checkpoints that cannot be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, List, Optional

import numpy as np
import pytest

from legs_loss import LegsError
from legs_loss.cli import main
from legs_loss.lab.ply import read_ply
from legs_loss.lab.training import checkpoint
from legs_loss.lab.training.checkpoint import CHECKPOINT, LOCK, read_checkpoint, write_checkpoint
from legs_loss.lab.training.trainer import TrainConfig, train
from legs_loss.scenes import Scene, read_scene
from legs_loss.system.locks import FileLock
from tests.lab.training import SHORT, assert_equal, run_until_killed
from tests.preloaded import run
from tests.support import colmap_scene, legs_environment

pytest.importorskip("numba")


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("at", [10, 30, 50])  # before the first periodic checkpoint, in and after densification
def test_a_resumed_run_ends_bit_equal(scene: Scene, tmp_path: Path, at: int) -> None:
    whole = train(scene, SHORT)
    run_until_killed(scene, tmp_path, SHORT, at)
    assert not (tmp_path / "metrics.json").exists()
    resumed = train(scene, SHORT, out=tmp_path, resume=True)
    assert_equal(resumed.gaussians, whole.gaussians)
    again = train(scene, SHORT, out=tmp_path, resume=True)  # finished: nothing left to do
    assert_equal(again.gaussians, whole.gaussians)
    runs = (whole.metrics, resumed.metrics, again.metrics)
    times = [(metrics.pop("seconds"), metrics.pop("processor_seconds")) for metrics in runs]
    assert whole.metrics == resumed.metrics == again.metrics
    assert times[1] == times[2]


def test_a_run_of_before_a_setting_can_be_resumed(scene: Scene, tmp_path: Path) -> None:
    run_until_killed(scene, tmp_path, SHORT, 20)
    arrays, facts = read_checkpoint(tmp_path / CHECKPOINT)
    del facts["config"]["position_lr_max_steps"]
    write_checkpoint(tmp_path / CHECKPOINT, arrays, facts)
    resumed = train(scene, SHORT, out=tmp_path, resume=True)
    assert_equal(resumed.gaussians, train(scene, SHORT).gaussians)


def test_a_checkpoint_of_another_run_is_refused(scene: Scene, tmp_path: Path) -> None:
    train(scene, replace(SHORT, iterations=2), out=tmp_path)
    with pytest.raises(LegsError, match="other settings"):
        train(scene, SHORT, out=tmp_path, resume=True)
    fewer = replace(scene, views=scene.views[:8])
    with pytest.raises(LegsError, match="other views"):
        train(fewer, replace(SHORT, iterations=2), out=tmp_path, resume=True)
    with pytest.raises(LegsError, match="no such checkpoint"):
        train(scene, SHORT, out=tmp_path / "empty", resume=True)
    with pytest.raises(LegsError, match="without an output folder"):
        train(scene, SHORT, resume=True)


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    write_checkpoint(path, {"a": np.arange(400.0)}, {"iteration": 7})
    arrays, facts = read_checkpoint(path)
    assert arrays["a"][399] == 399
    assert facts == {"iteration": 7}
    good = path.read_bytes()
    for length in range(0, len(good), 37):
        path.write_bytes(good[:length])
        with pytest.raises(LegsError, match=r"c\.npz.*damaged"):
            read_checkpoint(path)


def command(*arguments: Any) -> subprocess.CompletedProcess[str]:
    return run(arguments_of(*arguments), env=environment())


def arguments_of(*arguments: Any) -> List[str]:
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def environment() -> dict:
    return legs_environment()


def test_legs_train(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    flags = ("--preset", "legs-l", "--iterations", 20, "-r", 2, "--seed", 5, "--threads", 1)
    done = command("train", tiny_scene, "--out", out, *flags)
    assert done.returncode == 0, done.stderr
    assert "held-out views: PSNR" in done.stdout
    assert "Gaussians" in done.stderr
    assert "PSNR" in done.stderr
    config = TrainConfig(spec="legs-l", iterations=20, resolution=2, seed=5)
    expected = train(read_scene(tiny_scene), config)
    assert_equal(read_ply(out / "point_cloud" / "iteration_20" / "point_cloud.ply"), expected.gaussians)

    again = command("train", tiny_scene, "--out", out)
    assert again.returncode == 2
    assert "already holds a run" in again.stderr
    other = command("train", tiny_scene, "--out", out, "--resume", "--iterations", 30)
    assert other.returncode == 2
    assert "another iterations" in other.stderr
    resumed = command("train", tiny_scene, "--out", out, "--resume", *flags)
    assert resumed.returncode == 0, resumed.stderr
    assert resumed.stdout == done.stdout


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_loads_agree(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    flags = ("--preset", "legs", "--iterations", 20, "-r", 2, "--threads", 1)
    clouds = []
    for name in ("compiles", "loads"):
        arguments = arguments_of(
            "train", tiny_scene, "--out", tmp_path / name, *flags
        )  # numba reads where as it begins
        done = subprocess.run(arguments, env=environment(), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        clouds.append((tmp_path / name / "point_cloud" / "iteration_20" / "point_cloud.ply").read_bytes())
    assert list((tmp_path / "cache").rglob("*.nbc"))
    assert clouds[0] == clouds[1]


def mistaken(*arguments: str) -> Any:
    try:
        return main(arguments)
    except SystemExit as error:  # argparse's own
        return error.code


def test_mistakes_on_the_command_line(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for flags, message in (
        (("--preset", "leg"), "invalid choice"),
        (("--iterations", "0"), "iterations must be at least 1"),
        (("--resume",), "no such checkpoint"),
        (("-r", "-3"), "resolution must be"),
        (("--threads", "0"), "--threads must be between 1 and"),
        (("--checkpoint_every", "0"), "--checkpoint_every"),
        (("--store", str(tmp_path)), "not a store"),
    ):
        assert mistaken("train", str(tiny_scene), "--out", str(tmp_path / "run"), *flags) == 2, flags
        assert message in capsys.readouterr().err
    assert mistaken("train", str(tmp_path / "nowhere")) == 2
    assert "no folder" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_two_trainings_in_one_folder(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "WAIT", 0.1)
    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / LOCK, note="process 7", remove=True):
        for resume in (False, True):
            with pytest.raises(LegsError, match=r"another training writes there \(process 7\)"):
                train(scene, SHORT, out=tmp_path / "run", resume=resume)
    assert list((tmp_path / "run").iterdir()) == []
    (tmp_path / "run" / LOCK).mkdir()  # no lock is to be had: it trains all the same
    train(scene, replace(SHORT, iterations=2), out=tmp_path / "run")
    (tmp_path / "run" / LOCK).rmdir()
    train(scene, replace(SHORT, iterations=2), out=tmp_path / "run", resume=True)
    assert not (tmp_path / "run" / LOCK).exists()


def test_a_size_that_no_memory_holds_is_one_line(
    tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["train", str(tiny_scene), "--out", str(tmp_path / "run"), "-r", "999999999"]) == 2
    assert "legs: error: not enough memory" in capsys.readouterr().err


def wait_for(path: Path, process: subprocess.Popen[bytes], newer_than: Optional[float] = None) -> None:
    """Until the file is there (and has changed since)."""
    deadline = time.monotonic() + 120
    while not path.exists() or (newer_than is not None and path.stat().st_mtime_ns <= newer_than):
        assert process.poll() is None, "it ended too early"
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_ctrl_c_and_kill_9_lose_nothing_that_matters(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    flags = ("--iterations", 400, "-r", 4, "--threads", 1, "--checkpoint_every", 20)
    whole = command("train", tiny_scene, "--out", tmp_path / "whole", *flags)
    assert whole.returncode == 0, whole.stderr

    process = subprocess.Popen(arguments_of("train", tiny_scene, "--out", out, *flags), env=environment())
    wait_for(out / CHECKPOINT, process)
    wait_for(out / CHECKPOINT, process, (out / CHECKPOINT).stat().st_mtime_ns)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    interrupted = read_checkpoint(out / CHECKPOINT)[1]["iteration"]
    assert 0 < interrupted < 400

    resume = ("train", tiny_scene, "--out", out, "--resume", "--threads", 1, "--checkpoint_every", 20)
    process = subprocess.Popen(arguments_of(*resume), env=environment())
    wait_for(out / CHECKPOINT, process, (out / CHECKPOINT).stat().st_mtime_ns)
    process.kill()
    process.wait(60)
    assert interrupted < read_checkpoint(out / CHECKPOINT)[1]["iteration"] < 400

    resumed = command(*resume)
    assert resumed.returncode == 0, resumed.stderr
    files = [path / "point_cloud" / "iteration_400" / "point_cloud.ply" for path in (tmp_path / "whole", out)]
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(("command", "extra"), [("train", "cpu"), ("demo", "report")])  # with all that it needs
def test_missing_numba_is_one_clear_error(command: str, extra: str, tiny_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "numba.py").write_text("raise ImportError('no numba here')\n")
    env = environment()
    env["PYTHONPATH"] = os.pathsep.join([str(tmp_path), env["PYTHONPATH"]])
    failed = subprocess.run(
        arguments_of(command, tiny_scene, "--out", tmp_path / "run"), env=env, capture_output=True, text=True
    )
    assert failed.returncode == 2
    assert f"pip install numba, or, in the checkout of legs-loss, pip install '.[{extra}]'" in failed.stderr
    assert "Traceback" not in failed.stderr


@pytest.mark.parametrize("command", ["train", "demo", "compare", "view", "masks", "show", "info", "precompute"])
def test_every_command_that_reads_a_scene_speaks_of_a_larger_model(command: str, tmp_path: Path, capsys: Any) -> None:
    """A scene of one image beside a model of three; what else is wrong ends each command right after."""
    root = colmap_scene(tmp_path / "scene", names=["1.png"])
    three = colmap_scene(tmp_path / "three")
    (three / "sparse" / "0").rename(root / "sparse" / "1")
    (tmp_path / "run.ply").write_bytes(b"")
    arguments = {
        "train": [root, "-m", tmp_path / "out"],
        "demo": [root, "-m", tmp_path / "out"],
        "compare": [root, "-m", tmp_path / "out", "--iterations", 2],
        "view": [tmp_path / "run.ply", "-s", root, "--host", "no such address"],
        "masks": [root, "--from", "saturated"],
        "show": [root, "--out", tmp_path / "sheet.png"],
        "info": [root],
        "precompute": [root, "--workers", 1],
    }
    code = main([command, *map(str, arguments[command])])
    said = capsys.readouterr().err
    assert f"{root / 'sparse' / '1'} has 3 images, and 0, which is read here as 3DGS does, has 1;" in said
    if command in ("train", "demo", "compare"):
        assert code == 2 and "of its 1 view(s) none is left to train on" in said


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="torch has another OpenMP there")
@pytest.mark.parametrize("users", [None, "ACTIVE"])
@pytest.mark.parametrize("command", [["train", "nowhere"], ["run", "--cpu", "script.py"]])
def test_torch_s_idle_threads_do_not_spin_unless_the_user_says_so(
    command: List[str], users: Optional[str], tmp_path: Path
) -> None:
    (tmp_path / "script.py").write_text("import torch\n", encoding="utf-8")
    environment = {name: value for name, value in legs_environment().items() if name != "OMP_WAIT_POLICY"}
    environment.update(OMP_DISPLAY_ENV="TRUE", **({"OMP_WAIT_POLICY": users} if users else {}))
    command = [sys.executable, "-m", "legs_loss", *command]  # torch is loaded anew: then its OpenMP reads the variable
    done = subprocess.run(command, cwd=str(tmp_path), env=environment, capture_output=True, text=True, timeout=300)
    assert f"OMP_WAIT_POLICY = '{users or 'PASSIVE'}'" in done.stderr
