"""examples/reproduce_paper: what it would run, that it goes on where it stopped, and its count control."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, Iterator, List

import numpy as np
import pytest
from PIL import Image

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "reproduce_paper"

# A codebase with FastGS's arguments whose number of Gaussians follows its threshold.
TRAIN = """
import argparse, os, pathlib, time
parser = argparse.ArgumentParser()
parser.add_argument("-s"); parser.add_argument("-m"); parser.add_argument("--eval", action="store_true")
parser.add_argument("--grad_thresh", type=float, default=0.0002)
parser.add_argument("--grad_abs_thresh", type=float, default=0.0012)
args = parser.parse_args()
with open(pathlib.Path(args.s) / "log.txt", "a") as log:
    print(f"{os.path.basename(args.m)} {os.environ.get('LEGS_OFF')} {os.environ.get('LEGS_PRESET')}", file=log)
if (pathlib.Path(args.s) / "broken").exists():
    raise SystemExit(3)
while (pathlib.Path(args.s) / "endless").exists():
    time.sleep(0.05)
count = int(1000 * (0.0002 / args.grad_thresh) ** 0.8 * (2.5 if os.environ.get("LEGS_PRESET") else 1))
folder = pathlib.Path(args.m) / "point_cloud" / "iteration_7"
folder.mkdir(parents=True, exist_ok=True)
(folder / "point_cloud.ply").write_bytes(b"ply\\nformat ascii 1.0\\nelement vertex %d\\nend_header\\n" % count)
"""
RENDER = """
import argparse, pathlib
import numpy as np
from PIL import Image
parser = argparse.ArgumentParser()
parser.add_argument("-m")
out = pathlib.Path(parser.parse_args().m)
for split, names in (("train", "ab"), ("test", "c")):
    for kind, value in (("renders", 100), ("gt", 110)):
        folder = out / split / "ours_7" / kind
        folder.mkdir(parents=True, exist_ok=True)
        for name in names:
            Image.fromarray(np.full((16, 16, 3), value, np.uint8)).save(str(folder / (name + ".png")))
"""


@pytest.fixture
def reproduce(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(FOLDER))
    yield importlib.import_module("reproduce")
    for name in ("reproduce", "codebases", "scoring"):
        sys.modules.pop(name, None)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    root = tmp_path / "FastGS"
    root.mkdir()
    (root / "train.py").write_text(TRAIN)
    (root / "render.py").write_text(RENDER)
    (root / "train_base.sh").write_text(
        "python train.py -s ./datasets/tanksandtemples/truck --eval --dense 0.01 --grad_abs_thresh 0.0009\n"
        "python render.py -m output/truck --skip_train --mult 0.7\n"
    )
    return root


def run(*arguments: Any, data: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / "reproduce.py"), *map(str, arguments)]
    return subprocess.run(command, env=environment(), capture_output=True, text=True, cwd=str(data), encoding="utf-8")


def environment() -> Dict[str, str]:
    root = str(FOLDER.parents[1])
    return dict(os.environ, PYTHONPATH=os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])))


def test_a_dry_run_prints_every_command_and_runs_none(checkout: Path, tmp_path: Path) -> None:
    arguments = ["--inria", checkout, "--fastgs", checkout, "--nerficg", checkout, "--data", tmp_path]
    done = run(*arguments, "--scenes", "truck", "garden", "room", "--dry-run", "--out", "out", data=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if not line.startswith("#")]
    assert all(line.startswith(f"cd {checkout} && PYTHONHASHSEED=0 LEGS_") for line in lines)
    assert not (tmp_path / "out").exists()
    # 3 codebases x 3 scenes x (unpatched, three presets, three controls), two commands each, four for FasterGS.
    assert len(lines) == 3 * 7 * (2 + 2 + 4)
    inria = [line for line in lines if "/3dgs/" in line and " train.py " in line]
    assert all("--eval" in line for line in inria)
    assert all(("images_4" in line) == ("/garden/" in line) for line in inria)
    assert all(("images_2" in line) == ("/room/" in line) for line in inria)
    fast = [line for line in lines if "/fastgs/truck/" in line]
    plain, render = fast[:2]
    assert "--dense 0.01 --grad_abs_thresh 0.0009" in plain and "legs_loss" not in plain and "LEGS_OFF=1" in plain
    assert render.endswith("--mult 0.7")
    legs = next(line for line in fast if "/truck/legs " in line)
    assert "LEGS_PRESET=legs" in legs and "-m legs_loss run train.py" in legs
    control = next(line for line in fast if "/plain-at-legs-1 " in line)
    assert "--grad_thresh 0.0001 --grad_abs_thresh 0.00045" in control and "LEGS_OFF=1" in control


def test_a_run_its_count_control_and_going_on(
    reproduce: Any, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    codebases = importlib.import_module("codebases")

    def python(self: Any, preset: Any, words: List[str]) -> Any:
        """As it is, but without `legs run`, which would find no loss in the stand-in."""
        environment = {"LEGS_OFF": "1"} if preset is None else {"LEGS_PRESET": preset}
        return codebases.Command([sys.executable, *words], self.root, environment)

    monkeypatch.setattr(codebases.Codebase, "python", python)
    scene = tmp_path / "scene"
    scene.mkdir()
    codebase = codebases.FastGS(checkout, False, [])
    place = codebases.Place(scene, "own", "scene")
    (scene / "broken").touch()
    with pytest.raises(SystemExit, match=r"ended with 3; see .*train\.log"):
        reproduce.Run(tmp_path / "out", False).scene(codebase, place, ["legs"], True)
    (scene / "broken").unlink()
    run = reproduce.Run(tmp_path / "out", False)
    run.scene(codebase, place, ["legs"], True)
    plain, legs, control = run.rows
    assert (plain["gaussians"], legs["gaussians"]) == (1000, 2500)
    assert control["arm"] == "plain at legs's number"
    assert control["gaussians"] == pytest.approx(2500, rel=0.01)
    assert control["train"]["psnr"] == pytest.approx(20 * np.log10(255 / 10))
    assert (list(control["train"]["views"]), list(control["test"]["views"])) == (["a.png", "b.png"], ["c.png"])
    log = (scene / "log.txt").read_text().splitlines()
    assert log[:3] == ["plain 1 None", "plain 1 None", "legs None legs"]
    assert all(line.endswith("1 None") for line in log[3:])
    text = reproduce.tables(run.rows)
    assert "| scene | plain at legs's number | 28.13 |" in text and "1.2 to 1.7 dB" in text
    again = reproduce.Run(tmp_path / "out", False)
    again.scene(codebase, place, ["legs"], True)
    assert again.rows == run.rows
    assert (scene / "log.txt").read_text().splitlines() == log
    changed = codebases.FastGS(checkout, False, ["--eval"])
    with pytest.raises(SystemExit, match="done by other commands"):
        reproduce.Run(tmp_path / "out", False).scene(changed, place, ["legs"], True)


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_ctrl_c(checkout: Path, tmp_path: Path) -> None:
    (tmp_path / "endless").touch()
    words = [sys.executable, str(FOLDER / "reproduce.py"), "--fastgs", str(checkout), "--own", str(tmp_path)]
    process = subprocess.Popen(
        words, env=environment(), cwd=str(tmp_path), stderr=subprocess.PIPE, start_new_session=True
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "log.txt").exists():  # it trains
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    assert process.communicate(timeout=60)[1] == b"reproduce: interrupted: the same command goes on\n"
    assert process.returncode == 130
    assert not list((tmp_path / "reproduced").rglob("*.done"))


def test_a_patched_checkout_is_no_baseline(checkout: Path, tmp_path: Path) -> None:
    (checkout / "train.py").write_text("import legs_loss\n" + TRAIN)
    done = run("--fastgs", checkout, "--own", tmp_path, "--dry-run", data=tmp_path)
    assert done.returncode == 1
    assert "is patched already" in done.stderr


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_the_search_for_a_threshold_closes_in(reproduce: Any, power: float) -> None:
    tried = [(1.0, 1000), (0.5, round(1000 * 2**power))]
    while abs(tried[-1][1] / 3000 - 1) > reproduce.CLOSE:
        factor = reproduce.next_factor(tried, 3000)
        tried.append((factor, round(1000 * factor**-power)))
        assert len(tried) <= 1 + reproduce.TRIALS


def test_scores_are_of_the_pictures_on_disk(reproduce: Any, tmp_path: Path) -> None:
    scoring = importlib.import_module("scoring")
    for folder, value in (("a", 100), ("b", 100), ("c", 110)):
        (tmp_path / folder).mkdir()
        Image.fromarray(np.full((16, 16, 3), value, np.uint8)).save(str(tmp_path / folder / "0.png"))
    same = scoring.score(tmp_path / "a", tmp_path / "b")
    assert same["psnr"] == 120 and same["ssim"] == pytest.approx(1)
    (tmp_path / "c" / "0.png").rename(tmp_path / "c" / "1.png")
    with pytest.raises(ValueError, match="same views"):
        scoring.score(tmp_path / "a", tmp_path / "c")
    (tmp_path / "no.ply").write_bytes(b"ply\nend_header\nelement vertex 3\n")
    with pytest.raises(ValueError, match="no number of Gaussians"):
        scoring.gaussians(tmp_path / "no.ply")
