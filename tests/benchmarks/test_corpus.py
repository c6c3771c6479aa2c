"""The corpus check: it plans every checkout of a folder, and names the differences from an earlier run's plans."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict

import pytest

from benchmarks import corpus
from tests import preloaded
from tests.patcher.support import checkout
from tests.support import legs_environment

ROOT = Path(__file__).resolve().parents[2]
LOSS = """import torch


def l1_loss(network_output, gt):
    return torch.abs((network_output - gt)).mean()
"""
TRAIN = """from gaussian_renderer import render
from utils.loss_utils import l1_loss


def training(scene, gaussians, background):
    for viewpoint_cam in scene.getTrainCameras():
        image = render(viewpoint_cam, gaussians, background)["render"]
        gt_image = viewpoint_cam.original_image.cuda()
        loss = l1_loss(image, gt_image)
        loss.backward()
        gaussians.optimizer.step()
"""


@pytest.fixture
def trees(tmp_path: Path) -> Path:
    """Two checkouts: one that trains splats, and one without an L1."""
    checkout(tmp_path / "trees/splats", {"train.py": TRAIN, "utils/loss_utils.py": LOSS})
    checkout(tmp_path / "trees/empty", {"main.py": "print('no loss here')\n"})
    return tmp_path / "trees"


def run(*arguments: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks.corpus", *map(str, arguments)]
    return preloaded.run(command, cwd=str(ROOT), env=legs_environment())


def contents(folder: Path) -> Dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_change_of_one_checkout_is_named(trees: Path, tmp_path: Path) -> None:
    plans, before = tmp_path / "plans.json", contents(trees)
    saved = run(trees, plans, "--save", "--jobs", 2)
    assert (saved.returncode, saved.stdout) == (0, "")
    assert saved.stderr.startswith("2 plans in ")
    assert contents(trees) == before

    found = json.loads(plans.read_text())
    assert found["splats"]["exit"] == 1
    assert [(site["file"], site["line"]) for site in found["splats"]["sites"]] == [("train.py", 9)]
    assert found["empty"]["exit"] == 2
    assert str(tmp_path) not in plans.read_text()

    same = run(trees, plans)
    assert (same.returncode, same.stdout) == (0, "2 before, 2 after, 0 differ\n")

    (trees / "splats/train.py").write_text("import os\n" + TRAIN)  # the call site is one line further down
    other = run(trees, plans, "--sites")
    lines = other.stdout.splitlines()
    assert other.returncode == 1
    assert lines[0] == "splats"
    assert [line.split('"train.py", ')[1].split(",")[0] for line in lines[1:3]] == ["9", "10"]
    assert [line[:9] for line in lines[1:3]] == ["  - sites", "  + sites"]
    assert lines[3:] == ["2 before, 2 after, 1 differ"]


def test_words_count_only_without_sites(trees: Path, capsys: pytest.CaptureFixture[str]) -> None:
    site = {"file": "train.py", "line": 9, "column": 15, "channels_last": False}
    old = {"a": {"exit": 1, "sites": [site], "left": [{"file": "b.py", "line": 3, "why": "depth"}], "problems": []}}
    new = {"a": {**old["a"], "left": [{"file": "b.py", "line": 3, "why": "evaluation"}]}, "b": {"exit": 2}}
    assert corpus.compare(old, {"a": new["a"]}, sites=True) == 0
    assert capsys.readouterr().out == ""
    assert corpus.compare(old, new) == 2
    assert capsys.readouterr().out.splitlines() == [
        "a",
        '  - left: {"file": "b.py", "line": 3, "why": "depth"}',
        '  + left: {"file": "b.py", "line": 3, "why": "evaluation"}',
        "b",
        "  only after",
    ]


UNNAMED = """from gaussian_renderer import render
from utils.loss_utils import l1_loss


def training(scene, gaussians, background):
    for viewpoint_cam in scene.getTrainCameras():
        package = render(viewpoint_cam, gaussians, background)
        gt_image = viewpoint_cam.original_image.cuda()
        loss = l1_loss(package["render"], gt_image) + package["render"].mean()
        loss.backward()
        gaussians.optimizer.step()
"""


def test_masks_are_counted(trees: Path, tmp_path: Path) -> None:
    checkout(trees / "unnamed", {"train.py": UNNAMED, "utils/loss_utils.py": LOSS})
    done = run(trees, tmp_path / "masks.json", "--masks", "--jobs", 2)
    assert (done.returncode, done.stdout) == (
        0,
        "terms weighted: 2; lines that mask them: 1 written, 1 left to the user; "
        "checkouts in which all are written: 2 of 3\n",
    )
    sites = json.loads((tmp_path / "masks.json").read_text())["splats"]["sites"]
    assert [site.get("term") for site in sites] == [None, "mask"]


def test_an_ssim_is_no_weighted_term() -> None:
    plan = {"sites": [{"file": "train.py"}, {"term": "ssim"}, {"term": "mask"}]}
    assert corpus.masks_in({"splats": plan}).startswith("terms weighted: 1; lines that mask them: 1 written")


def test_another_order_is_a_difference(capsys: pytest.CaptureFixture[str]) -> None:
    assert corpus.compare({"a": {"left": [1, 2]}}, {"a": {"left": [2, 1]}}) == 1
    assert capsys.readouterr().out.splitlines() == ["a", "  left: the same elements in another order"]


def test_a_checkout_that_takes_too_long_is_left_at_the_limit(trees: Path) -> None:
    started = time.perf_counter()
    found, seconds = corpus.plan(trees / "splats", 0.001)
    assert found == {"error": "no plan within 0.001 s"}
    assert seconds <= time.perf_counter() - started


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/none", "plans.json"], "none: no folder with checkouts in it"),
        (["{trees}", "{tmp}/none.json"], "no plans can be read there"),
        (["{trees}", "{tmp}/list.json"], "not a file that --save wrote"),
        (["{trees}", "plans.json", "--jobs", "0"], "--jobs and --limit must be greater than 0"),
    ],
)
def test_bad_usage_is_said(
    trees: Path, tmp_path: Path, arguments: Any, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "list.json").write_text("[1]")
    with pytest.raises(SystemExit) as stopped:
        corpus.main([text.format(tmp=tmp_path, trees=trees) for text in arguments])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err
