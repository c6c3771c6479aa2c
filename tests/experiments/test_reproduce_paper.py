"""examples/reproduce_paper: the commands that it runs, with each codebase's official settings."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "reproduce_paper" / "reproduce.py"
TRAIN_BASE = """
OAR_JOB_ID=truck CUDA_VISIBLE_DEVICES=0 python train.py -s ./datasets/tanksandtemples/truck -m out/truck --eval --grad_abs_thresh 0.0008
CUDA_VISIBLE_DEVICES=0 python train.py -s ./datasets/mipnerf360/garden -i images_4 --eval --dense 0.01
"""  # noqa: E501


def reproduce(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, str(SCRIPT), *words], capture_output=True, text=True)


def test_each_codebase_and_scene_is_one_comparison(tmp_path: Path) -> None:
    (tmp_path / "train_base.sh").write_text(TRAIN_BASE)
    root = str(tmp_path)
    checkouts = ["--inria", "INRIA", "--fastgs", root, "--nerficg", "NERF"]
    done = reproduce(*checkouts, "--data", "DATA", "--scenes", "truck", "garden", "room", "--dry-run")
    assert done.returncode == 0, done.stderr
    lines = [line.partition("compare.py ")[2] for line in done.stdout.splitlines()]
    assert len(lines) == 9 and all(line.startswith("DATA/") for line in lines)
    find = {(line.split("--profile ")[1].split()[0], line.split()[0].rpartition("/")[2]): line for line in lines}
    assert "--images images_4" in find["3dgs", "garden"] and "--images images_2" in find["3dgs", "room"]
    assert "--images" not in find["3dgs", "truck"]
    assert find["fastgs", "truck"].endswith("'--extra=--grad_abs_thresh 0.0008'")
    assert "--images images_4" in find["fastgs", "garden"] and "'--extra=--dense 0.01'" in find["fastgs", "garden"]
    assert find["fastergs", "garden"].endswith(" -r 4") and find["fastergs", "room"].endswith(" -r 2")
    assert "-m reproduced/fastergs/truck" in find["fastergs", "truck"]


def test_it_ends_with_the_first_comparison_that_fails(tmp_path: Path) -> None:
    done = reproduce("--inria", str(tmp_path), "--data", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert done.stdout.count("compare.py") == 1 and "compare: error: " in done.stderr
    assert "name at least one checkout" in reproduce("--data", "DATA").stderr
