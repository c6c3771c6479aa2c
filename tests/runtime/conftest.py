"""Fixtures of the tests of the runtime."""

from __future__ import annotations

import pytest

from tests.support import start_run


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder."""
    start_run(monkeypatch, tmp_path)
