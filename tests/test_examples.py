"""Every example runs as its user would run it."""

from __future__ import annotations

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
