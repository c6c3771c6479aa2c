"""Many scenes, here and on a real dask scheduler with real workers, on this machine's loopback."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from legs_loss import LegsError
from legs_loss.precompute.many_scenes import find_scenes, stores_of
from legs_loss.store import WeightStore
from tests.support import colmap_scene, legs, legs_command, legs_environment, photograph, save

CLUSTER = "127.0.0.1"


def contents(store):
    """A store's files and their bytes; the lock and the note of the scene's place left out."""
    left_out = (".lock", "scene.json")
    return {path.name: path.read_bytes() for path in store.iterdir() if path.is_file() and path.name not in left_out}


@pytest.fixture
def scenes(tmp_path):
    return [colmap_scene(tmp_path / "scenes" / f"scene{i}", names=[f"{i}{j}.png" for j in range(3)]) for i in range(3)]


class TestWhichScenes:
    def test_folders_globs_and_lists(self, scenes, tmp_path):
        (tmp_path / "list.txt").write_text(f"# mine\nscenes/scene1\n\n{scenes[0]}\nscenes/scene*\n")
        assert find_scenes([str(scenes[2]), str(scenes[2])]) == scenes[2:]
        assert find_scenes([str(tmp_path / "scenes" / "*[01]")]) == scenes[:2]
        assert find_scenes([str(tmp_path / "list.txt")]) == [scenes[1], scenes[0], scenes[2]]
        odd = colmap_scene(tmp_path / "a[1]")
        assert find_scenes([str(odd)]) == [odd]

    def test_what_means_no_scene(self, tmp_path):
        (tmp_path / "list.txt").write_text("# nothing\n")
        with pytest.raises(LegsError, match="names no scene"):
            find_scenes([str(tmp_path / "list.txt")])
        with pytest.raises(LegsError, match="no folder matches"):
            find_scenes([str(tmp_path / "x*")])

    def test_lists_in_lists(self, scenes, tmp_path):
        for name, line in (
            ("all", "some.txt\nscenes/scene2\nsome.txt"),
            ("some", "scenes/scene0"),
            ("self", "self.txt"),
        ):
            (tmp_path / f"{name}.txt").write_text(line + "\n")
        (tmp_path / "one.txt").write_text("other.txt\n")
        (tmp_path / "other.txt").write_text("scenes/scene0\none.txt\n")
        (tmp_path / "bytes.txt").write_bytes(b"\xe9t\xe9")
        assert find_scenes([str(tmp_path / "all.txt")]) == [scenes[0], scenes[2]]
        for name in ("self", "one", "other"):
            with pytest.raises(LegsError, match="is a list that names itself"):
                find_scenes([str(tmp_path / f"{name}.txt")])
        with pytest.raises(LegsError, match=r"cannot read .*bytes\.txt"):
            find_scenes([str(tmp_path / "bytes.txt")])

    def test_stores_in_another_folder(self, scenes, tmp_path):
        assert stores_of(scenes[:1], "maps") == [Path("maps")]
        assert stores_of(scenes, "maps") == [Path("maps/scene0"), Path("maps/scene1"), Path("maps/scene2")]
        twin = colmap_scene(tmp_path / "scene0")
        with pytest.raises(LegsError, match="2 scenes have the name scene0"):
            stores_of([scenes[0], twin], "maps")


class TestHere:
    def test_several_scenes_one_of_them_broken(self, scenes):
        (scenes[1] / "sparse" / "0" / "images.bin").write_bytes(b"cut")
        done = legs("precompute", *scenes, "--workers", 1)
        assert done.returncode == 1, done.stderr
        assert done.stdout.count(": 3 made, 0 up to date, 0 skipped\n") == 2
        assert f"legs: error: {scenes[1]}: " in done.stderr
        assert "2 of 3 scenes" in done.stderr or "3 of 3 scenes" in done.stderr
        assert legs("precompute", scenes[0], "--workers", 1).stdout.endswith(": 0 made, 3 up to date, 0 skipped\n")

    def test_without_dask_it_says_what_to_install(self, scenes, tmp_path):
        (tmp_path / "distributed.py").write_text("raise ImportError('hidden')")
        environment = legs_environment()
        environment["PYTHONPATH"] = f"{tmp_path}:{environment['PYTHONPATH']}"
        done = legs("precompute", scenes[0], "--scheduler", "tcp://127.0.0.1:1", env=environment)
        assert done.returncode == 2
        assert done.stderr == (
            "legs: error: --scheduler needs distributed: pip install distributed, or, in the checkout of legs-loss, "
            "pip install '.[cluster]'\n"
        )  # and no bar

    @pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="mounting needs root")
    def test_a_full_disk_is_one_error(self, tmp_path):
        scene = colmap_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(8)], width=400, height=300)
        with small_disk(tmp_path / "disk", "1m"):
            done = legs("precompute", scene, "--out", tmp_path / "disk" / "store", "--workers", 1)
            assert done.returncode == 2
            assert "No space left on device" in done.stderr
            assert done.stderr.count("No space left") == 1
            assert "Traceback" not in done.stderr
            store = WeightStore(tmp_path / "disk" / "store")  # what fitted is whole
            assert 0 < len(store.entries) < 8
            assert store.check()[0] == []


@contextmanager
def small_disk(path, size):
    path.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(path)], capture_output=True)
    if made.returncode:
        pytest.skip(f"cannot mount a tmpfs: {made.stderr.decode().strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(path)], check=True)


class Cluster:
    """A real scheduler and its workers; every process is ended afterwards."""

    def __init__(self, folder):
        self.folder, self.processes = folder, []
        self.environment = dict(legs_environment(), DASK_DISTRIBUTED__WORKER__DAEMON="False")
        self.log = folder / "scheduler.log"
        self.scheduler = self.start("scheduler", self.log, "--host", CLUSTER, "--port", "0", "--no-dashboard")
        self.address = self.wait_for(self.log, r"Scheduler at:\s+(tcp://\S+)")

    def start(self, what, log, *arguments, **options):
        command = [sys.executable, "-m", "distributed.cli.dask_" + what, *arguments]
        with open(str(log), "w") as file:
            process = subprocess.Popen(
                command, stdout=file, stderr=file, cwd=str(self.folder), **{"env": self.environment, **options}
            )
        self.processes.append(process)
        return process

    def worker(self, **options):
        log = self.folder / f"worker{len(self.processes)}.log"
        arguments = ["--host", CLUSTER, "--nthreads", "1", "--no-nanny", "--no-dashboard", "--memory-limit", "0"]
        process = self.start("worker", log, self.address, *arguments, **options)
        return process, self.wait_for(log, r"Start worker at:\s+(tcp://\S+)")

    def wait_for(self, log, pattern):
        for _ in range(600):
            found = re.search(pattern, log.read_text())
            if found:
                return found.group(1)
            time.sleep(0.1)
        raise AssertionError(log.read_text())

    def close(self):
        for process in reversed(self.processes):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "cluster").mkdir()
    running = Cluster(tmp_path / "cluster")
    yield running
    running.close()


@pytest.mark.slow
class TestCluster:
    def test_stores_are_those_of_this_machine(self, cluster, scenes):
        cluster.worker()
        cluster.worker()
        done = legs("precompute", *scenes, "--scheduler", cluster.address)
        assert done.returncode == 0, done.stderr
        assert done.stdout.count(": 3 made, 0 up to date, 0 skipped\n") == 3
        assert "3 of 3 scenes: 100%" in done.stderr
        assert "9/9" in done.stderr
        theirs = [contents(scene / "legs_weights") for scene in scenes]
        for scene in scenes:
            shutil.rmtree(str(scene / "legs_weights"))
        assert legs("precompute", *scenes, "--workers", 1).returncode == 0
        assert [contents(scene / "legs_weights") for scene in scenes] == theirs

    def test_a_worker_that_is_killed_loses_nothing(self, cluster, tmp_path):
        scene = tmp_path / "scene"
        for number in range(60):
            save(scene / f"{number:02}.png", photograph(600, 500, number))
        first, _ = cluster.worker()
        command = legs_command("precompute", scene, "--scheduler", cluster.address)
        running = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=legs_environment()
        )
        manifest = scene / "legs_weights" / "manifest.json"
        for _ in range(4800):
            if manifest.is_file() or running.poll() is not None:
                break
            time.sleep(0.05)
        first.send_signal(signal.SIGKILL)
        first.wait()
        kept = len(WeightStore(manifest.parent).entries)
        assert 0 < kept < 60
        cluster.worker()
        output, errors = running.communicate(timeout=300)
        assert running.returncode == 0, errors
        made, up_to_date = map(int, re.search(r": (\d+) made, (\d+) up to date, 0 skipped", output).groups())
        assert made + up_to_date == 60
        assert up_to_date >= kept
        store = WeightStore(manifest.parent)
        assert store.check() == ([], [])
        theirs = contents(manifest.parent)
        shutil.rmtree(str(manifest.parent))
        assert legs("precompute", scene, "--workers", 1).returncode == 0
        assert contents(manifest.parent) == theirs

    @pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="mounting needs root")
    def test_a_missing_mount_names_the_worker(self, cluster, tmp_path, scenes):
        """The folder is gone on the worker and stays here."""
        if shutil.which("unshare") is None:
            pytest.skip("needs unshare")
        hide = f"mount -t tmpfs tmpfs {tmp_path / 'scenes'} && exec {sys.executable} -m distributed.cli.dask_worker"
        log = cluster.folder / "hidden.log"
        arguments = f" {cluster.address} --host {CLUSTER} --nthreads 1 --no-nanny --no-dashboard --memory-limit 0"
        with open(str(log), "w") as file:
            hidden = subprocess.Popen(
                ["unshare", "--mount", "sh", "-c", hide + arguments],
                stdout=file,
                stderr=file,
                cwd=str(cluster.folder),
                env=cluster.environment,
            )
        cluster.processes.append(hidden)
        address = cluster.wait_for(log, r"Start worker at:\s+(tcp://\S+)")
        done = legs("precompute", scenes[0], "--scheduler", cluster.address)
        assert done.returncode == 2
        (line,) = [line for line in done.stderr.splitlines() if "legs: error" in line]
        assert f"worker {address}" in line
        assert f"there is no folder {scenes[0]} here: is the file system with the scenes mounted?" in line
        assert not (scenes[0] / "legs_weights").exists()

    def test_no_scheduler_and_no_worker(self, cluster, scenes, monkeypatch):
        from legs_loss.precompute import executors

        monkeypatch.setattr(executors, "_PATIENCE", 1)
        for address, message in (
            ("tcp://127.0.0.1:9", "no dask scheduler answers at tcp://127.0.0.1:9"),
            (cluster.address, "has no workers"),
        ):
            with pytest.raises(LegsError, match=message):
                list(executors.outcomes(print, ["task"], print, scheduler=address))

    def test_a_comparison_is_that_of_this_machine(self, cluster, tiny_scene, tmp_path):
        pytest.importorskip("numba")
        import json

        from tests.support import without_times

        cluster.worker()
        cluster.worker()
        rows = {}
        for name, options in (("here", []), ("there", ["--scheduler", cluster.address])):
            arguments = ["--arms", "legs", "--seeds", 1, "--iterations", 30, "--out", tmp_path / name, *options]
            done = legs("compare", tiny_scene, *arguments)
            assert done.returncode == 0, done.stderr
            found = sorted((tmp_path / name).glob("*/seed-0/row.json"))
            rows[name] = [without_times(json.loads(path.read_text())["metrics"]) for path in found]
        assert len(rows["here"]) == 2
        assert rows["there"] == rows["here"]
