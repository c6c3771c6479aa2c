"""examples/reproduce_paper: the commands that it runs, with each codebase's official settings."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import torch

from examples.reproduce_paper.robust import RobustMask

SCRIPT = Path(__file__).resolve().parents[3] / "examples" / "reproduce_paper" / "reproduce.py"
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
    lines = [re.split("compare.py'? ", line)[-1] for line in done.stdout.splitlines()]  # of a path with a space
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


def test_a_robust_mask_leaves_out_patches_that_stand_out() -> None:
    target = torch.full((3, 10, 8), 0.5)
    prediction = target + 0.01
    prediction[:, 0:4, 0:3] += 0.3  # 12 of the first patch's 16 pixels; 9 after the 3x3 majority
    prediction[:, 5, 5] += 0.3  # a single pixel
    prediction[:, 8:, :4] += 0.3  # a patch that the edge cuts
    prediction.requires_grad_()
    mask = RobustMask(percentile=50, factor=6, warmup=1, patch=4, share=0.5)
    assert mask(prediction, target) is prediction  # the warm-up; the median is 0.01
    seen = mask(prediction, target)
    seen.sum().backward()
    counts = torch.ones(10, 8)
    counts[0:4, 0:4] = counts[8:, 0:4] = 0
    assert prediction.grad is not None and torch.equal(prediction.grad, counts.expand(3, 10, 8))
    assert torch.equal(seen[:, 0:4, 0:4], target[:, 0:4, 0:4])
    with torch.no_grad():
        assert mask(prediction, target) is prediction


def test_the_running_percentile() -> None:
    mask = RobustMask(percentile=90, decay=0.75, warmup=0, patch=1)
    mask.left_out(torch.arange(1.0, 101.0).reshape(10, 10))
    assert mask.running == 90.0
    mask.left_out(torch.arange(1.0, 101.0).reshape(10, 10) + 8)
    assert mask.running == 92.0  # 0.75 * 90 + 0.25 * 98
