"""Every example runs as its user would run it."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_the_training_loop_learns():
    pytest.importorskip("numba")
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "training_loop.py"), "--iterations", "100"],
        env=dict(os.environ, PYTHONPATH=str(ROOT)),
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    assert "L1 weighted, preset legs" in result.stderr
    losses = [float(value) for value in re.findall(r"loss (\d+\.\d+)", result.stdout)]
    assert len(losses) == 2
    assert losses[1] < losses[0]


@pytest.mark.slow
def test_arms_are_trained_milestone_by_milestone(tiny_scene, tmp_path):
    pytest.importorskip("numba")
    script = ROOT / "examples" / "reproduce_paper" / "schedule.py"
    words = [str(tiny_scene), str(tmp_path), "--until", "1000", "-r", "24", "--arms", "3dgs@legs"]
    for _ in range(2):  # the second time everything is there
        result = subprocess.run(
            [sys.executable, str(script), *words],
            env=dict(os.environ, PYTHONPATH=str(ROOT)),
            capture_output=True,
            text=True,
        )
        assert result.returncode == 0, result.stderr
    found = {name: json.loads((tmp_path / name / "metrics-1000.json").read_text()) for name in ("legs", "3dgs-at-legs")}
    assert [one["iterations"] for one in found.values()] == [999, 999]
    assert found["3dgs-at-legs"]["gaussians"] == pytest.approx(found["legs"]["gaussians"], rel=0.02)
    assert result.stdout == ""
