"""A full disk under each writer: one clear error, nothing of the user's lost, and once there is room it goes on."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from legs_loss.cli import main
from legs_loss.errors import LegsError
from legs_loss.kernels.cuda.modules import BinaryCache
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import read_ply, write_ply
from legs_loss.lab.training.checkpoint import read_state
from legs_loss.scenes import View, load_training_image
from legs_loss.store import WeightStore
from tests.precompute.test_cluster import Cluster
from tests.support import colmap_scene, legs

pytestmark = pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="mounting a small disk needs root")

FULL = "No space left on device"


class Disk:
    """A disk of one megabyte."""

    def __init__(self, path):
        self.path = path

    @contextmanager
    def full(self, room=0):
        """Leave so many bytes of it meanwhile."""
        filler = self.path / "filler"
        with open(str(filler), "wb", buffering=0) as file:
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(4096))
            file.truncate(file.tell() // 4096 * 4096 - room)
        yield
        filler.unlink()

    def state(self):
        return {
            str(path.relative_to(self.path)): path.read_bytes()
            for path in sorted(self.path.rglob("*"))
            if path.is_file() and path.name not in ("filler", ".lock")
        }


@pytest.fixture
def disk(tmp_path):
    path = tmp_path / "disk"
    path.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(path)], capture_output=True)
    if made.returncode:
        pytest.skip(f"cannot mount a tmpfs: {made.stderr.decode().strip()}")
    yield Disk(path)
    subprocess.run(["umount", "-l", str(path)], check=True)


def one_error(capsys, code):
    said = capsys.readouterr().err
    errors = [line for line in said.splitlines() if "error:" in line]
    assert (code, len(errors)) == (2, 1), said
    assert FULL in errors[0]
    assert "Traceback" not in said


@pytest.mark.parametrize("room", [0, 4096, 8192])
def test_patch_and_undo(room, disk, tmp_path, capsys, monkeypatch):
    from legs_adapters.cli import main as legs_patch

    from tests.patcher.support import checkout, files

    root = checkout(disk.path / "checkout", files("inria"))
    before = disk.state()
    with disk.full(room):
        one_error(capsys, legs_patch([str(root)]))
        assert disk.state() == before
    assert legs_patch([str(root)]) == 0
    patched = disk.state()
    assert patched != before
    capsys.readouterr()
    with disk.full(room):
        code = legs_patch(["--undo", str(root)])
        if code:  # it may fit: what is put back is smaller than what goes
            one_error(capsys, code)
            assert disk.state() == patched
    assert disk.state() == before or legs_patch(["--undo", str(root)]) == 0
    assert disk.state() == before


def test_precompute(disk, tmp_path, capsys):
    scene = colmap_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(4)], width=200, height=150)
    store = disk.path / "store"
    assert main(["precompute", str(scene), "--out", str(store), "-r", "2", "--workers", "1"]) == 0
    capsys.readouterr()
    before = disk.state()
    with disk.full(40_960):
        one_error(capsys, main(["precompute", str(scene), "--out", str(store), "--workers", "1"]))
        after = disk.state()
        assert all(after[name] == data for name, data in before.items() if name.endswith(".npy"))
        assert WeightStore(store).check()[0] == []
    assert main(["precompute", str(scene), "--out", str(store), "--workers", "1"]) == 0
    assert len(WeightStore(store).entries) == 8
    assert not [name for name in disk.state() if ".writing" in name or name.endswith(".part")]


@pytest.mark.slow
def test_precompute_by_a_cluster(disk, tmp_path):
    """The error names the worker whose disk it is; what fitted is whole, and is kept by the next run."""
    pytest.importorskip("distributed")
    scene = colmap_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(8)], width=200, height=150)
    store = disk.path / "store"
    cluster = Cluster(tmp_path)
    try:
        _, address = cluster.worker()
        command = ["precompute", scene, "--out", store, "--scheduler", cluster.address]
        with disk.full(200_000):
            done = legs(*command)
            (line,) = [line for line in done.stderr.splitlines() if "error" in line]
            assert done.returncode == 2 and f"worker {address}" in line and FULL in line
            kept = len(WeightStore(store).entries)
            assert 0 < kept < 8 and WeightStore(store).check()[0] == []
        done = legs(*command)
        assert done.stdout.endswith(f": {8 - kept} made, {kept} up to date, 0 skipped\n"), done.stderr
        assert WeightStore(store).check() == ([], [])
        assert not [name for name in disk.state() if ".writing" in name or name.endswith(".part")]
    finally:
        cluster.close()


def test_train(disk, tiny_scene, capsys):
    out = disk.path / "run"
    small = ["--iterations", "8", "-r", "2", "--threads", "1", "--checkpoint_every", "4"]
    with disk.full(4096):
        one_error(capsys, main(["train", str(tiny_scene), "--out", str(out), *small]))
    with disk.full(450_000):  # for one checkpoint, not for two at once
        one_error(capsys, main(["train", str(tiny_scene), "--out", str(out), *small]))
        assert read_state(out / "checkpoint.npz")[1]["iteration"] == 0
        assert not list(out.rglob("*.part"))
    go_on = ["train", str(tiny_scene), "--out", str(out), "--resume", "--threads", "1"]
    assert main(go_on) == 0
    assert len(read_ply(out / "point_cloud" / "iteration_8" / "point_cloud.ply")) > 0


def in_this_process(arms, processes, on_progress, on_done=lambda name, metrics: None, scheduler=None):
    """Train arms one after another, in place of a process for each."""
    from legs_loss.lab.training.side_by_side import train_arm

    found = {}
    for arm in arms:
        found[arm.name] = train_arm(arm, lambda progress: None)
        on_done(arm.name, found[arm.name])
    return found


@pytest.mark.slow
def test_compare_and_report(disk, tiny_scene, capsys, monkeypatch):
    pytest.importorskip("jinja2")
    from legs_loss.lab.experiments import running

    monkeypatch.setattr(running, "train_side_by_side", in_this_process)
    subprocess.run(["mount", "-o", "remount,size=8m", str(disk.path)], check=True)
    out = disk.path / "out"
    compare = ["compare", str(tiny_scene), "--out", str(out), "--iterations", "6", "-r", "2", "--seeds", "1"]
    compare += ["--arms", "legs"]
    for room in (0, 8192, 450_000):
        with disk.full(room):
            one_error(capsys, main(compare))
    assert main(compare) == 0
    assert main(["report", str(out)]) == 0
    capsys.readouterr()
    before = disk.state()
    with disk.full(40_960):
        one_error(capsys, main(["report", str(out)]))
        assert disk.state() == before
        assert main(compare) == 0, "there is nothing to train"


@pytest.mark.slow
def test_demo(disk, tiny_scene, capsys, monkeypatch):
    """One error wherever its room ends; an earlier demo's files stay whole."""
    pytest.importorskip("matplotlib")
    from legs_loss.lab.training import side_by_side

    monkeypatch.setattr(side_by_side, "train_side_by_side", in_this_process)
    subprocess.run(["mount", "-o", "remount,size=8m", str(disk.path)], check=True)
    out = disk.path / "demo"
    demo = ["demo", str(tiny_scene), "--out", str(out), "--iterations", "6", "-r", "2", "--processes", "1"]
    for room in (0, 40_960, 200_000):
        with disk.full(room):
            one_error(capsys, main(demo))
        assert not list(out.rglob("*.part"))
    assert main(demo) == 0
    capsys.readouterr()
    before = disk.state()
    assert "demo/results.json" in before
    with disk.full(8192):
        one_error(capsys, main(demo))
        after = disk.state()
    assert all(after[name] for name in before), "half a file"
    assert main(demo) == 0


@pytest.mark.parametrize("room", [0, 8192])
def test_masks_and_export(room, disk, tmp_path, capsys):
    """Own masks, their place in a store, and maps as pictures: what is there is whole, and there is no other."""
    scene = colmap_scene(tmp_path / "scene", names=[f"{i}.png" for i in range(4)], width=200, height=150)
    masks, store, out = disk.path / "masks", disk.path / "store", disk.path / "out"
    make = ["masks", str(scene), "--from", "dark", "--out", str(masks)]
    precompute = ["precompute", str(scene), "--masks", str(masks), "--out", str(store), "--workers", "1"]
    export = ["export", str(store), str(out)]
    for command, written in ((make, masks), (precompute, store), (export, out)):
        with disk.full(room):
            one_error(capsys, main(command))
            assert not list(disk.path.rglob("*.part"))
            if written is store:
                assert not (store / "manifest.json").exists() or WeightStore(store).check() == ([], [])
            for picture in written.rglob("*.png"):
                load_training_image(View("a", picture))
        if written is not store and written.exists():  # only a new or an empty folder is written to
            shutil.rmtree(str(written))
        assert main(command) == 0
        capsys.readouterr()
    assert len(WeightStore(store).of_kind("mask")) == 4 and WeightStore(store).check() == ([], [])
    assert len(list(out.rglob("*.png"))) == 12


@pytest.mark.parametrize("what", ["--verify", "--trace"])
def test_a_full_folder_of_temporary_files(what, disk, tmp_path, capsys, monkeypatch):
    """It holds the copies and the reports of a run: one error, and nothing stays there."""
    pytest.importorskip("numba")
    from legs_adapters.cli import main as legs_patch

    from tests.patcher.support import checkout, files, snapshot

    root = checkout(tmp_path / "checkout", {**files("inria"), "data": bytes(100_000)})
    before = snapshot(root)
    monkeypatch.setattr(tempfile, "tempdir", str(disk.path))
    more = ["--trace", "train.py", "--cpu"] if what == "--trace" else ["--verify"]
    with disk.full(40_960):
        one_error(capsys, legs_patch([*more, str(root)]))
        assert disk.state() == {}
    if what == "--verify":  # it patches first, and says so
        assert legs_patch(["--undo", str(root)]) == 0
    assert snapshot(root) == before


def test_show(disk, tiny_scene, capsys):
    pytest.importorskip("matplotlib")
    image, sheet = str(next((tiny_scene / "images").iterdir())), disk.path / "sheet.png"
    sheet.write_bytes(b"of before")
    with disk.full(8192):
        one_error(capsys, main(["show", image, "--out", str(sheet)]))
        assert disk.state() == {"sheet.png": b"of before"}
    assert main(["show", image, "--out", str(sheet)]) == 0


def test_the_demo_s_scene_and_pictures(disk):
    from legs_loss.lab.report.comparison import Compared, save_pictures

    with disk.full(8192):
        with pytest.raises(LegsError, match=FULL):
            write_embedded_scene(disk.path / "scene", views=3, width=96, height=64, points=300, samples=1)
        assert not (disk.path / "scene" / "sparse" / "0" / "points3D.bin").exists(), "taken for a whole scene"
        assert not list(disk.path.rglob("*.part"))
    pytest.importorskip("matplotlib")
    picture = torch.rand(3, 64, 96)
    with disk.full(8192), pytest.raises(LegsError, match=FULL):
        save_pictures(disk.path / "p", "title", picture, [Compared("legs", picture, torch.ones(1, 64, 96), "a")])
    assert not list(disk.path.rglob("*.part"))


def test_gaussians(disk):
    some = Gaussians.from_points(np.random.rand(500, 3).astype(np.float32), np.full((500, 3), 9, np.uint8), 1)
    path = disk.path / "g.ply"
    write_ply(path, some)
    before = path.read_bytes()
    with disk.full(8192):
        with pytest.raises(LegsError, match=FULL):
            write_ply(path, some)
        assert disk.state() == {"g.ply": before}


def test_compiled_kernels(disk, tiny_scene):
    """A kernel that cannot be kept is compiled again next time, without an error."""
    cache = BinaryCache(disk.path / "cuda")
    with disk.full():
        cache.put(b"key", b"binary")
        assert cache.get(b"key") is None
    cache.put(b"key", b"binary")
    with disk.full():
        cache.put(b"key", bytes(100_000))
        assert cache.get(b"key") == b"binary"
    assert [path.suffix for path in (disk.path / "cuda").iterdir()] == [".bin"]


@pytest.mark.slow
def test_numba_s_cache(disk, tiny_scene, tmp_path):
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(disk.path / "numba"))
    with disk.full(4096):
        done = legs("precompute", tiny_scene, "--out", tmp_path / "store", "--workers", 1, env=environment)
    assert "Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr
