"""The benchmarks that are scripts, at a tiny size: each still runs with the code of today; its numbers mean nothing."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any, Sequence

import pytest

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_loss.lab.embedded import write_embedded_scene
from tests import preloaded
from tests.cuda_emulation import COMPILER
from tests.support import legs, legs_environment

ROOT = Path(__file__).resolve().parents[2]
TRAIN = """from utils.loss_utils import l1_loss
import gaussian_renderer


def training(image, gt_image, gaussians):
    loss = l1_loss(image, gt_image)
    loss.backward()
    gaussians.optimizer.step()
"""


def run(*arguments: str, codes: Sequence[int] = (0,), **settings: str) -> Any:
    path = os.pathsep.join([str(ROOT), str(ROOT / "adapters")])
    environment = dict(legs_environment(), PYTHONPATH=path, **settings)
    done = preloaded.run([sys.executable, *arguments], cwd=str(ROOT), env=environment, timeout=1500)
    assert done.returncode in codes, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
class TestScripts:
    @pytest.mark.skipif(COMPILER is None, reason="no g++")
    def test_the_time_of_python_on_a_gpu(self) -> None:
        found = run("benchmarks/cuda_host.py", "--rounds", "1", codes=(0, 1))  # 1: above a goal, as any busy machine is
        assert "of a thin wrapper of SSIM; the goal is 1.0" in found and "the goal is 1.1" in found

    def test_the_drop_in(self) -> None:
        assert "ours / it" in run("benchmarks/drop_in.py", "--size", "40x30", "--rounds", "1")

    def test_the_stand_ins(self) -> None:
        tiny = ["--width", "32", "--height", "24", "--points", "200", "--rounds", "1"]
        assert "| surfels, all channels" in run("benchmarks/cpu.py", *tiny)

    def test_the_rasterizer(self) -> None:
        tiny = ["--gaussians", "200", "--size", "32", "24", "--rounds", "1", "--peer-rounds", "1"]
        assert "torch oracle" in run("-m", "benchmarks.rasterizer", *tiny)

    def test_the_blending_of_a_strip(self) -> None:
        assert [line.split(":")[0] for line in run("-m", "benchmarks.vectors").splitlines()] == ["forward", "backward"]

    def test_precompute(self, tmp_path: Path) -> None:
        file = tmp_path / "found.json"
        tiny = ["--workers", "1", "--photographs", "2", "--rounds", "1", "--resolution", "8"]
        run("benchmarks/precompute.py", *tiny, "--json", str(file))
        assert json.loads(file.read_text(encoding="utf-8"))

    def test_the_parts_of_a_training_step(self, tmp_path: Path) -> None:
        out = tmp_path / "out"
        scene = write_embedded_scene(tmp_path / "scene", views=6, width=320, height=240, points=20_000, samples=1)
        assert legs("train", scene, "--out", out, "--iterations", "3").returncode == 0
        counted = []
        for threads in ("1", "2"):
            few = ["--rounds", "1", "--iterations", "4", "--threads", threads]
            found = run("benchmarks/training.py", str(scene), str(out), *few, NUMBA_NUM_THREADS=threads)
            first, *table = found.splitlines()
            rest = next(row for row in table if row.startswith("| the rest"))
            assert float(rest.split("|")[2]) > 0, table  # no part is counted twice
            counted.append(first.split(" pixels, ")[0])
        assert counted[0] == counted[1]  # Gaussians, entries and rows

    def test_the_files_that_a_reader_walks_through(self, tmp_path: Path) -> None:
        (tmp_path / "train.py").write_text(TRAIN, encoding="utf-8")
        assert "verdict" in run("benchmarks/walks.py", str(tmp_path))
