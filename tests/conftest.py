"""Fixtures of all tests: the real capture and a browser, where they are present, and a fixed seed."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import sys
from pathlib import Path
from typing import Any, Iterator

import pytest
import torch
from hypothesis import HealthCheck, settings

# Each process of the suite would compile each test and module again, where the environment asks that no code is kept.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The same examples in every run; how long a busy machine takes to draw one says nothing about the code.
settings.register_profile(
    "repeatable",
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much],
)
settings.load_profile("repeatable")

# Tests that run side by side share the processor's cores.
if "PYTEST_XDIST_WORKER" in os.environ:
    torch.set_num_threads(1)

# A suite that a shell started in the background ignores Ctrl-C, and would hand that on to every program that it tests.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

FOX = Path(os.environ.get("LEGS_TEST_SCENE", Path(__file__).resolve().parents[2] / "shared" / "scenes" / "fox"))


@pytest.fixture(scope="session")
def fox() -> Path:
    """The real COLMAP capture; a test that asks for it is skipped where the folder is absent."""
    if not (FOX / "images").is_dir():
        pytest.skip("the real capture is not on this machine (set LEGS_TEST_SCENE to a COLMAP scene)")
    return FOX


@pytest.fixture(autouse=True)
def seed() -> None:
    """Random inputs are the same in every run."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The embedded scene at 64x48 with 12 views, for real trainings of seconds. Not to be written to."""
    from legs_loss.lab.embedded import write_embedded_scene

    root = tmp_path_factory.mktemp("tiny") / "table"
    return write_embedded_scene(root, views=12, width=64, height=48, points=900, samples=2)


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Of the processes that share the suite, the first compiles what trains; the others wait, and load it."""
    if "PYTEST_XDIST_WORKER" not in os.environ or importlib.util.find_spec("numba") is None:
        return
    from legs_loss.lab.embedded import write_embedded_scene
    from legs_loss.system.locks import FileLock
    from tests.support import legs

    folder = tmp_path_factory.getbasetemp().parent / "compiled"  # one for all processes of this run
    folder.mkdir(exist_ok=True)
    with FileLock(folder / "lock"):
        if not (folder / "run").exists():
            write_embedded_scene(folder / "scene", views=3, width=32, height=24, points=200, samples=1)
            legs("train", folder / "scene", "--out", folder / "run", "--iterations", 3)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api")
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium (Debian: apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        # A container's root has no sandbox; the page is our own.
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()
