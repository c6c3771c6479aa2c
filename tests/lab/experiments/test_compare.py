"""`legs compare`: rows that are complete, resume and can be run alone; and the command itself."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Dict, List

import pytest
import torch
from PIL import Image

from legs_loss import LegsError, weight_map
from legs_loss.cli import main
from legs_loss.lab.experiments.arms import parse_arm, parse_arms
from legs_loss.lab.experiments.tables import markdown, scores_table
from legs_loss.weights import Weights

pytest.importorskip("numba")
pytest.importorskip("scipy")


from legs_loss.lab.experiments.running import Comparison, read_rows
from legs_loss.lab.training import trainer
from legs_loss.lab.training.checkpoint import CHECKPOINT
from legs_loss.lab.training.side_by_side import train_arm
from legs_loss.lab.training.trainer import TrainConfig, train
from legs_loss.precompute import UserMaps, precompute
from legs_loss.scenes import read_scene
from tests.lab.experiments.support import BASE
from tests.lab.training import train_one
from tests.preloaded import PATH, run
from tests.support import without_times


@pytest.mark.slow
def test_rows_are_complete_and_can_be_run_alone(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    comparison = Comparison(tiny_scene, BASE, out)
    arms = parse_arms(["legs", "legs:shuffled", "legs@3dgs"])
    told: List[str] = []
    rows = comparison.train(arms, [0, 1], 2, lambda name, progress: told.append(name))
    assert sorted({(row["arm"], row["seed"]) for row in rows}) == sorted(
        (arm, seed) for arm in ("3dgs", "legs", "legs:shuffled", "legs@3dgs") for seed in (0, 1)
    )
    assert "legs@3dgs, seed 1" in told
    settings, read = read_rows(out)
    assert sorted(map(json.dumps, read)) == sorted(map(json.dumps, rows))
    assert settings["baseline"]["views"] == 10
    assert not list(out.rglob(CHECKPOINT))
    by_name = {(row["arm"], row["seed"]): row for row in rows}
    assert by_name["3dgs", 0]["metrics"]["mean_weight"] == 1.0
    for seed in (0, 1):
        plain, counted = by_name["3dgs", seed]["metrics"], by_name["legs@3dgs", seed]["metrics"]
        assert counted["gaussians"] == pytest.approx(plain["gaussians"], rel=0.01)
        assert counted["growth"] == plain["growth"]
    row = by_name["legs@3dgs", 1]
    assert row["versions"]["torch"] == torch.__version__
    # From its row alone, by the trainer.
    again = train(
        read_scene(tiny_scene),
        TrainConfig.from_dict(row["config"]),
        caps={iteration: count for iteration, count in row["caps"]},
        evaluate_every=4,
    ).metrics
    assert without_times(again) == without_times(row["metrics"])
    # Given again, nothing is trained.
    del told[:]
    assert comparison.train(arms, [0, 1], 2, lambda name, progress: told.append(name)) == rows
    assert not told


def test_masks_of_the_scenes_store_hold_for_every_arm(tiny_scene: Path, tmp_path: Path) -> None:
    shutil.copytree(str(tiny_scene), str(tmp_path / "scene"))
    (tmp_path / "scene/masks").mkdir()
    views = read_scene(tmp_path / "scene").views
    for view in views:
        mask = Image.new("L", (64, 48), 255)
        mask.paste(0, (0, 0, 16, 48))
        mask.save(str(tmp_path / "scene/masks" / f"{PurePosixPath(view.name).stem}.png"))
    precompute(read_scene(tmp_path / "scene"), resolution=2, maps=UserMaps("masks"))
    comparison = Comparison(tmp_path / "scene", BASE, tmp_path / "out")
    rows = [train_one(comparison, arm, 0) for arm in parse_arms(["3dgs", "legs:scale"])]
    assert [row["metrics"]["masked_views"] for row in rows] == [10, 10]
    assert rows[0]["metrics"]["mean_weight"] == pytest.approx(1.0, abs=1e-6)
    maps = [weight_map(view.image, "legs")[..., 8:].double().mean() for view in comparison.data.train]
    assert rows[1]["metrics"]["mean_weight"] == pytest.approx(float(sum(maps)) / len(maps), rel=1e-3)


def test_weights_of_ones_own_in_the_store_are_refused_before_anything_is_written(
    tiny_scene: Path, tmp_path: Path
) -> None:
    shutil.copytree(str(tiny_scene), str(tmp_path / "scene"))
    (tmp_path / "scene/importance").mkdir()
    trained = read_scene(tmp_path / "scene").views[1].name
    Image.new("L", (64, 48), 255).save(str(tmp_path / "scene/importance" / f"{PurePosixPath(trained).stem}.png"))
    precompute(read_scene(tmp_path / "scene"), resolution=2, maps=UserMaps(weights="importance", scale=3.0))
    with pytest.raises(
        LegsError, match=rf"{trained} has a weight map of mean 3\.000: .* --weights\? Move the store away"
    ):
        Comparison(tmp_path / "scene", BASE, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    shutil.rmtree(str(tmp_path / "scene/legs_weights"))
    assert Comparison(tmp_path / "scene", BASE, tmp_path / "out").proof["views"] == 10


def test_an_interrupted_row_goes_on(tiny_scene: Path, tmp_path: Path) -> None:
    whole = train_one(Comparison(tiny_scene, BASE, tmp_path / "whole"), parse_arm("legs:shuffled"), 0)
    out = tmp_path / "out"
    arm = parse_arm("legs:shuffled")
    begun = Comparison(tiny_scene, BASE, out)._training("a", arm, 0)

    class Killed(BaseException):
        pass

    def kill(progress: trainer.Progress) -> None:
        if progress.iteration == 20:
            raise Killed

    with pytest.raises(Killed):
        train_arm(begun, kill)
    assert (out / arm.folder / "seed-0" / CHECKPOINT).is_file()
    row = train_one(Comparison(tiny_scene, BASE, out), arm, 0)
    assert without_times(row["metrics"]) == without_times(whole["metrics"])


def test_a_baseline_is_proven_anew_when_a_comparison_goes_on(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Comparison(tiny_scene, BASE, tmp_path)
    plain = trainer.step_loss
    monkeypatch.setattr(
        "legs_loss.lab.experiments.baseline.step_loss",
        lambda prediction, target, weight, share: plain(
            prediction, target, Weights(map=weight_map(target, "legs")), share
        ),
    )
    with pytest.raises(LegsError, match="the baseline's loss is not 3DGS's"):
        Comparison(tiny_scene, BASE, tmp_path)


@pytest.mark.parametrize("damage", ["{", "{}", "[]", '{"arm": "legs", "seed": 0}'])
def test_damaged_files_are_named(damage: str, tiny_scene: Path, tmp_path: Path) -> None:
    comparison = Comparison(tiny_scene, BASE, tmp_path)
    row = tmp_path / "3dgs" / "seed-0" / "row.json"
    row.parent.mkdir(parents=True)
    row.write_text(damage)
    for read in (lambda: comparison.row(parse_arm("3dgs"), 0), lambda: read_rows(tmp_path)):
        with pytest.raises(LegsError, match=r"row.json: this file is damaged"):
            read()
    (tmp_path / "comparison.json").write_text(damage)
    with pytest.raises(LegsError, match=r"comparison.json: this file is damaged"):
        Comparison(tiny_scene, BASE, tmp_path)


def test_where_nothing_can_be_written(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "file").write_text("")
    settings = ["--iterations", "4", "-r", "2", "--seeds", "1", "--processes", "1"]
    for scene in ([str(tiny_scene)], []):  # its own scene is written there first
        assert main(["compare", *scene, *settings, "--out", str(tmp_path / "file")]) == 2
        assert capsys.readouterr().err.startswith(f"legs: error: cannot write to {tmp_path / 'file'}")
    out = tmp_path / "out"
    out.mkdir()
    (out / "3dgs").write_text("")
    assert main(["compare", str(tiny_scene), *settings, "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "cannot write" in error and "Traceback" not in error


def test_another_comparison_in_the_folder_is_refused(tiny_scene: Path, tmp_path: Path) -> None:
    Comparison(tiny_scene, BASE, tmp_path)
    with pytest.raises(LegsError, match=r"started with another base.iterations"):
        Comparison(tiny_scene, replace(BASE, iterations=50), tmp_path)
    with pytest.raises(LegsError, match="uses the numbers of 3dgs: train that first"):
        train_one(Comparison(tiny_scene, BASE, tmp_path), parse_arm("legs@3dgs"), 0)
    with pytest.raises(LegsError, match="none of this comparison's rows is trained yet"):
        read_rows(tmp_path)
    with pytest.raises(LegsError, match="no comparison here"):
        read_rows(tmp_path / "elsewhere")
    (tmp_path / "comparison.json").write_text("{")
    with pytest.raises(LegsError, match="damaged"):
        Comparison(tiny_scene, BASE, tmp_path)


def command(*arguments: Any) -> List[str]:
    return [sys.executable, "-m", "legs_loss", *map(str, arguments)]


def environment() -> Dict[str, str]:
    return dict(os.environ, PYTHONPATH=PATH)


def test_the_command(tiny_scene: Path, tmp_path: Path) -> None:
    before = sorted(tiny_scene.rglob("*"))
    arguments = command("compare", tiny_scene, "--out", tmp_path / "out", "--iterations", 20, "-r", 2, "--seeds", 2)
    arguments += ["--processes", "2", "--arms", "legs", "legs@3dgs"]
    done = run(arguments, env=environment())
    assert done.returncode == 0, done.stderr
    assert sorted(tiny_scene.rglob("*")) == before
    assert "The baseline is unweighted: over 10 views" in done.stdout
    assert "6 of 6 trainings to do" in done.stdout
    rows = read_rows(tmp_path / "out")[1]
    assert len(rows) == 6
    assert markdown(*scores_table(rows, ["3dgs", "legs", "legs@3dgs"])) in done.stdout
    assert "Too short to decide: 20 iterations" in done.stdout and "legs − 3dgs" not in done.stdout
    again = run(arguments, env=environment())
    assert again.returncode == 0
    assert "0 of 6 trainings to do" in again.stdout


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
@pytest.mark.slow
def test_ctrl_c_keeps_the_rows_that_are_done(tiny_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = command("compare", tiny_scene, "--out", out, "--iterations", 150, "-r", 1, "--processes", 1)
    process = subprocess.Popen(arguments, env=environment(), stderr=subprocess.PIPE, start_new_session=True)
    deadline = time.monotonic() + 240
    while not (out / "3dgs" / "seed-0" / "row.json").exists():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    assert b"Traceback" not in stderr
    assert read_rows(out)[1][0]["arm"] == "3dgs"


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
@pytest.mark.slow
def test_killed_it_goes_on(tiny_scene: Path, tmp_path: Path) -> None:
    """Killed with no chance to clean up: its trainings end by themselves, in silence, and finished ones are used."""
    out = tmp_path / "out"
    arguments = command("compare", tiny_scene, "--out", out, "--iterations", 150, "-r", 1, "--processes", 1)
    arguments += ["--seeds", "1", "--arms", "legs"]
    with open(str(tmp_path / "stderr"), "wb") as stderr:
        process = subprocess.Popen(arguments, env=environment(), stderr=stderr, start_new_session=True)
        deadline = time.monotonic() + 240
        while not (out / "legs" / "seed-0" / CHECKPOINT).exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.kill()
        process.wait()
    done = run(arguments, env=environment())
    assert done.returncode == 0, done.stderr
    assert "1 of 2 trainings to do" in done.stdout
    assert b"Traceback" not in (tmp_path / "stderr").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seeds", "0"], "--seeds must be at least 1"),
        (["--arms", "legs:louder"], "no change is named 'louder'"),
        (["--iterations", "0"], "iterations must be at least 1"),
    ],
)
def test_mistakes_on_the_command_line(
    arguments: List[str], says: str, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["compare", str(tiny_scene), "--out", str(tmp_path / "out"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("legs: error: ") and says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
