"""Fixtures of the tests of the runtime."""

from __future__ import annotations

import pytest

from legs_loss.runtime import state
from tests.support import start_run


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder."""
    start_run(monkeypatch, tmp_path)
    yield
    state.reset()  # what follows in this process, such as a doctest, is none of its steps
