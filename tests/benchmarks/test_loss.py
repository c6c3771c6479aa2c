"""The benchmark of the loss at a tiny size: it runs and writes every row; its numbers mean nothing."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("numba")

from benchmarks.losses import timing
from benchmarks.losses.tables import at_bandwidth
from tests import preloaded
from tests.support import legs_environment

ROOT = Path(__file__).resolve().parents[2]
NAMES = ["LEGS, weights in the kernel", "LEGS, stored map", "3DGS (torch)"]


def run(*arguments: str, **settings: str) -> Any:
    command = [sys.executable, "benchmarks/loss.py", *arguments]
    return preloaded.run(command, cwd=str(ROOT), env=dict(legs_environment(), **settings), timeout=1500)


@pytest.mark.slow
def test_the_contenders_are_timed_in_turns(tmp_path: Path) -> None:
    file = tmp_path / "loss.json"
    arguments = ["--size", "40x30", "--rounds", "2", "--parts", "loss", "--json", str(file), "--only", *NAMES]
    done = run(*arguments, LEGS_BACKEND="numba")
    assert done.returncode == 0, done.stderr
    assert "unavailable" not in done.stderr
    found = json.loads(file.read_text())
    assert list(found["loss"]) == NAMES
    for row in found["loss"].values():
        assert len(row["ms"]) == 2
        assert min(row["ms"]) > 0


@pytest.mark.slow
def test_one_thread_and_two_take_turns(tmp_path: Path) -> None:
    file = tmp_path / "threads.json"
    arguments = ["--size", "40x30", "--rounds", "3", "--parts", "threads", "--threads", "2", "--json", str(file)]
    done = run(*arguments, "--only", NAMES[1], LEGS_BACKEND="numba")
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(file.read_text())["threads"].values()
    one, two = row["ms"]
    middle, least, greatest = row["gain"]
    assert min(one, two) > 0 and 0 < least <= middle <= greatest


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_missing_gpu_is_said() -> None:
    done = run("--device", "cuda")
    assert done.returncode == 2
    assert done.stderr.endswith("error: torch finds no CUDA GPU here\n")


def test_the_bytes_that_must_move(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 10x10 pixels: three float32 read twice, written once, with the weights; a copy moves two."""
    monkeypatch.setattr(timing, "COPIED", 1 << 20)
    monkeypatch.setattr(timing, "timed", lambda step, device: step() is None or 1e-3)
    table = {name: {"median ms": 1.0} for name in NAMES}
    at_bandwidth(table, (10, 10), torch.device("cpu"))
    assert [row["bytes"] for row in table.values()] == [(3 * 16 + 16) * 100, (3 * 12 + 4) * 100, 3 * 12 * 100]
    at_that = 1e3 * 6400 / (2 * (1 << 20) / 1e-3)
    assert table[NAMES[0]]["ms at a copy's bandwidth"] == pytest.approx(at_that)
    assert table[NAMES[0]]["share of a copy's bandwidth"] == pytest.approx(at_that / 1.0)
