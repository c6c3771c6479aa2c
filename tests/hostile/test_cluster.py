"""Two dask schedulers whose workers write to one store, and a scheduler that goes away."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess

import pytest

from legs_loss.store import WeightStore
from tests.precompute.test_cluster import Cluster, contents
from tests.support import legs, legs_command, legs_environment, photograph, save

# Not imported here: it takes a second, and most processes of the suite run no test of this file.
pytestmark = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="distributed is not installed")
pytestmark = pytest.mark.slow
VIEWS = 24


@pytest.fixture
def clusters(tmp_path):
    """Two schedulers, each with a worker of its own."""
    running = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        running.append(Cluster(tmp_path / name))
        running[-1].worker()
    yield running
    for cluster in running:
        cluster.close()


@pytest.fixture
def scene(tmp_path):
    for number in range(VIEWS):
        save(tmp_path / "scene" / f"{number:02}.png", photograph(300, 200, number))
    return tmp_path / "scene"


def start(scene, cluster, *options):
    command = legs_command("precompute", scene, "--scheduler", cluster.address, *options)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=legs_environment())


@pytest.mark.parametrize("options", [[], ["-r", "2"]], ids=["the same maps", "other sizes"])
def test_two_schedulers_on_one_store(options, clusters, scene):
    running = [start(scene, clusters[0]), start(scene, clusters[1], *options)]
    made = 0
    for one in running:
        output, errors = one.communicate(timeout=300)
        assert one.returncode == 0, errors
        assert "Traceback" not in errors
        made += int(output.rsplit(": ", 1)[1].split()[0])
    assert made >= VIEWS * (1 + bool(options))  # each asked before the other wrote, some are made twice
    store = scene / "legs_weights"
    assert WeightStore(store).check() == ([], [])
    theirs = contents(store)
    shutil.rmtree(str(store))
    assert legs("precompute", scene, "--workers", 1).returncode == 0
    assert not options or legs("precompute", scene, "--workers", 1, *options).returncode == 0
    assert contents(store) == theirs


def test_a_scheduler_that_is_killed_is_one_error(clusters, scene):
    """The other one's work goes on, and completes the store."""
    manifest = scene / "legs_weights" / "manifest.json"
    first = start(scene, clusters[0])
    while not manifest.is_file() and first.poll() is None:
        pass
    clusters[0].close()
    _, errors = first.communicate(timeout=300)
    assert "Traceback" not in errors
    assert first.returncode == 2
    assert errors.count("legs: error") == errors.count("the scheduler went away: what was done is kept") == 1
    second = start(scene, clusters[1])
    assert second.communicate(timeout=300) and second.returncode == 0
    assert WeightStore(manifest.parent).check() == ([], [])
    assert len(WeightStore(manifest.parent).entries) == VIEWS
