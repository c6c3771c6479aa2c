"""Fixtures of the tests of the runtime."""

from __future__ import annotations

import os
import sys

import pytest

from legs_loss.runtime import state


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder."""
    for name in [name for name in os.environ if name.startswith("LEGS_")]:
        monkeypatch.delenv(name)
    state.reset()
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.chdir(tmp_path)
