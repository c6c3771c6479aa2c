"""precompute writes the maps that a training would compute, and carries on whatever happens."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss.errors import LegsError
from legs_loss.operators import OPERATORS
from legs_loss.precompute import normalised_map, precompute
from legs_loss.responses import normalise_response, response
from legs_loss.scenes import image_tensor, images, load_training_image, read_scene
from legs_loss.spec import PRESETS, WeightSpec
from legs_loss.store import WeightStore, fingerprint
from legs_loss.weights import weight_from_response, weight_map
from tests.support import ROOT, colmap_scene, legs, legs_command, legs_environment, photograph, save

HALF_ROUNDING = 2.0**-12  # of float16 between 1/2 and 1, where it is coarsest
needs_proc = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")


def stored(store, view="0001", width=40, height=30, preset="legs"):
    opened = WeightStore(store)
    return opened.normalised_response(opened.find(view, height, width, PRESETS[preset]))


class TestMap:
    @pytest.mark.parametrize("operator", OPERATORS)
    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_strips_give_the_response_of_the_whole(self, operator, p, monkeypatch):
        spec = WeightSpec(operator=operator, p=p)
        monkeypatch.setattr(images, "STRIP_PIXELS", 3 * 37)  # three rows at a time
        for height, width in ((50, 37), (1, 37), (37, 1), (2, 37), (7, 200)):
            image = photograph(width, height)
            whole = normalise_response(response(image_tensor(image), operator, p, channels_last=False), spec.eps)
            assert np.array_equal(normalised_map(image, spec), whole[0].half().numpy())

    def test_gray_deep_and_constant_images(self):
        gray = photograph(40, 30, channels=1)
        deep = gray.astype(np.uint16) * 257
        spec = WeightSpec()
        assert np.abs(normalised_map(gray, spec).astype("f4") - normalised_map(deep, spec)).max() < 1e-3
        assert not normalised_map(np.full((9, 9, 3), 77, np.uint8), spec).any()

    def test_rounding_to_float16_is_within_its_bound(self):
        image = photograph(300, 200)
        exact = normalise_response(response(image_tensor(image)))[0].numpy()
        half = normalised_map(image, WeightSpec())
        assert np.abs(half - exact).max() <= HALF_ROUNDING
        assert half.min() == 0
        assert half.max() == 1

    @pytest.mark.parametrize("curve", ["C1", "C2", "C3", "C4"])
    def test_weights_of_stored_maps_are_within_their_bound(self, curve):
        # |f(x + d) - f(x)| for the steepest place of each curve: C2 and C4 rise by at most 2 and 1.5 times d. C3's
        # slope grows without end towards 0, but float16's error shrinks faster: sqrt(x) 2^-12 down to its smallest
        # step, 2^-24, where half of it is worth 2^-12.5.
        bound = {"C1": 1, "C2": 2, "C3": 1, "C4": 1.5}[curve] * HALF_ROUNDING
        spec = WeightSpec(curve=curve)
        image = photograph(300, 200)
        weight = weight_map(image_tensor(image), spec)
        from_store = weight_from_response(torch.from_numpy(normalised_map(image, spec))[None], spec)
        assert (weight - from_store).abs().max() <= spec.beta * bound + 1e-5


class TestPrecompute:
    def test_the_map_is_that_of_the_image_the_training_uses(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path, width=41, height=31))
        report = precompute(scene, resolution=2)
        assert (len(report.made), report.kept, report.skipped) == (3, [], {})
        assert report.store == tmp_path / "legs_weights"
        upstream = Image.open(str(tmp_path / "images" / "0001.png")).resize((20, 16))
        target = torch.from_numpy(np.array(upstream)).permute(2, 0, 1) / 255.0
        store = WeightStore(report.store)
        entry = store.find("0001", 16, 20, PRESETS["legs"])
        assert entry.fingerprint == fingerprint(target)
        expected = normalise_response(response(target))[0].numpy()
        assert np.abs(store.normalised_response(entry) - expected).max() <= HALF_ROUNDING

    def test_the_real_capture(self, fox, tmp_path):
        scene = read_scene(fox)
        report = precompute(scene, tmp_path, resolution=180)
        assert len(report.made) == 50
        store = WeightStore(tmp_path)
        for view in scene.views:
            entry = store.find(view.name, 320, 180, PRESETS["legs"])
            assert entry.fingerprint == fingerprint(load_training_image(view, 180))

    def test_sizes_and_operators_share_a_store(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path))
        for resolution, preset in ((1, "legs"), (2, "legs"), (1, "eggs")):
            precompute(scene, resolution=resolution, spec=preset)
        assert len(WeightStore(tmp_path / "legs_weights").entries) == 9
        for resolution, preset in ((1, "legs"), (2, "legs"), (1, "eggs"), (1, "legs-l")):  # the curve is not stored
            assert len(precompute(scene, resolution=resolution, spec=preset).kept) == 3

    def test_again_changes_nothing(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path))
        precompute(scene)
        before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in files(tmp_path / "legs_weights")}
        assert len(precompute(scene).kept) == 3
        assert {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in before} == before
        assert set(files(tmp_path / "legs_weights")) == set(before)

    def test_what_changed_is_made_again(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path))
        precompute(scene)
        old = stored(tmp_path / "legs_weights", "0002")
        save(tmp_path / "images" / "0002.png", photograph(40, 30, seed=99))
        assert precompute(scene).made == ["images/0002.png"]
        assert not np.array_equal(stored(tmp_path / "legs_weights", "0002"), old)
        os.utime(str(tmp_path / "images" / "0003.png"), (1, 1))
        assert precompute(scene).made == ["images/0003.png"]

    def test_a_damaged_map_is_repaired(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path))
        precompute(scene)
        a, b, _ = sorted((tmp_path / "legs_weights").glob("*.npy"))
        a.write_bytes(a.read_bytes()[:-1] + b"!")
        b.unlink()
        assert len(precompute(scene).made) == 2
        assert WeightStore(tmp_path / "legs_weights").check() == ([], [])

    def test_background_is_part_of_the_image(self, tmp_path):
        save(tmp_path / "train" / "a.png", photograph(40, 30, channels=4))
        (tmp_path / "transforms_train.json").write_text(
            '{"camera_angle_x": 1, "frames": [{"file_path": "train/a", "transform_matrix": '
            "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}"
        )
        scene = read_scene(tmp_path)
        precompute(scene)
        black = stored(tmp_path / "legs_weights", "a")
        assert precompute(scene, white_background=True).made == ["train/a.png"]
        assert not np.array_equal(stored(tmp_path / "legs_weights", "a"), black)
        assert precompute(scene, white_background=True).kept == ["train/a.png"]

    def test_names_that_differ_in_case_only(self, tmp_path):
        save(tmp_path / "one" / "a.png", photograph(8, 8, 1))
        save(tmp_path / "two" / "A.png", photograph(8, 8, 2))
        precompute(read_scene(tmp_path), tmp_path / "store")
        assert not np.array_equal(*(stored(tmp_path / "store", name, 8, 8) for name in ("a", "A")))

    def test_bad_settings_are_one_error(self, tmp_path):
        scene = read_scene(colmap_scene(tmp_path))
        with pytest.raises(LegsError, match="resolution"):
            precompute(scene, resolution=-3)
        with pytest.raises(LegsError, match="preset"):
            precompute(scene, spec="logs")
        assert not (tmp_path / "legs_weights").exists()


def files(folder):
    return sorted(path for path in folder.iterdir() if path.is_file())


class TestCommand:
    def test_a_scene(self, tmp_path):
        colmap_scene(tmp_path)
        done = legs("precompute", tmp_path, "--workers", 2)
        assert (done.returncode, done.stdout) == (0, f"{tmp_path / 'legs_weights'}: 3 made, 0 up to date, 0 skipped\n")
        assert "weight maps" in done.stderr
        again = legs("precompute", tmp_path, "--workers", 1)
        assert "0 made, 3 up to date" in again.stdout
        assert WeightStore(tmp_path / "legs_weights").check() == ([], [])

    def test_options(self, tmp_path):
        colmap_scene(tmp_path)
        (tmp_path / "images").rename(tmp_path / "photos")
        done = legs(
            *("precompute", tmp_path, "--images", "photos", "-r", 20, "--out", tmp_path / "o", "--preset", "eggs"),
            *("--workers", 1, "-w"),
        )
        assert done.returncode == 0, done.stderr
        assert stored(tmp_path / "o", "photos/0001.png", 20, 15, "eggs").shape == (15, 20)

    def test_broken_photographs_are_named_and_the_rest_is_done(self, tmp_path):
        colmap_scene(tmp_path)
        broken = tmp_path / "images" / "0002.png"
        broken.write_bytes(broken.read_bytes()[:700])
        (tmp_path / "images" / "0003.png").unlink()
        for workers in (1, 2):
            done = legs("precompute", tmp_path, "--workers", workers, "--out", tmp_path / f"s{workers}")
            assert done.returncode == 1
            assert f"legs: skipped images/0002.png: {broken}: not an image" in done.stderr
            assert "legs: skipped images/0003.png" in done.stderr
            assert "Traceback" not in done.stderr
            assert "1 made, 0 up to date, 2 skipped" in done.stdout
            assert stored(tmp_path / f"s{workers}").shape == (30, 40)

    def test_names_that_3dgs_cannot_tell_apart_are_said(self, tmp_path):
        save(tmp_path / "a" / "1.png", photograph(8, 8))
        save(tmp_path / "b" / "1.png", photograph(8, 8))
        done = legs("precompute", tmp_path, "--workers", 1)
        assert done.returncode == 0
        assert "2 views share a name in 3DGS" in done.stderr

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["absent"], "there is no folder absent"),
            (["{scene}", "--workers", "0"], "--workers"),
            (["{scene}", "-r", "0"], "resolution"),
            (["{scene}", "--images", "absent"], "--images"),
            (["{scene}", "--out", "{scene}/images/0001.png"], "cannot write"),
            (["{scene}", "--preset", "logs"], "invalid choice"),
        ],
    )
    def test_bad_input_is_one_line_and_code_2(self, tmp_path, arguments, message):
        colmap_scene(tmp_path)
        done = legs("precompute", *[argument.format(scene=tmp_path) for argument in arguments])
        assert done.returncode == 2
        assert message in done.stderr
        assert "Traceback" not in done.stderr
        assert done.stdout == ""

    def test_a_damaged_manifest_is_one_error(self, tmp_path):
        colmap_scene(tmp_path)
        (tmp_path / "legs_weights").mkdir()
        (tmp_path / "legs_weights" / "manifest.json").write_text("{")
        done = legs("precompute", tmp_path, "--workers", 1)
        assert done.returncode == 2
        assert "manifest.json is damaged: delete that file" in done.stderr


WAITING = """
import os
import sys
import time

parent = os.getppid()


def wait(event, given):
    if event == "open" and str(given[0]).endswith("5a.png"):
        while os.getppid() == parent:
            time.sleep(0.05)


sys.addaudithook(wait)
"""


@needs_proc
class TestInterrupted:
    """Runs that are stopped while they work.

    Whoever opens one photograph of the scene waits, by a hook of Python's, as long as its parent lives: the run cannot
    finish first.
    """

    @pytest.fixture
    def scene(self, tmp_path):
        for name in ("0", "1", "2", "3", "4", "5", "5a"):
            save(tmp_path / "scene" / f"{name}.png", photograph(64, 48, int(name[0])))
        (tmp_path / "hooks").mkdir()
        (tmp_path / "hooks" / "sitecustomize.py").write_text(WAITING)
        return tmp_path / "scene"

    @pytest.fixture
    def out(self, tmp_path):
        return tmp_path / "out"

    def start(self, scene, out, workers):
        environment = legs_environment()
        hooks = [str(scene.parent / "hooks"), environment.get("PYTHONPATH", "")]
        environment["PYTHONPATH"] = os.pathsep.join(hook for hook in hooks if hook)
        process = subprocess.Popen(
            legs_command("precompute", scene, "--out", out, "--workers", workers),
            cwd=str(ROOT),
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        wait_until(lambda: (out / "manifest.json").exists() or process.poll() is not None)
        assert process.poll() is None, process.stderr.read()
        return process

    def finish(self, scene, out, kept):
        (scene / "5a.png").unlink()
        save(scene / "5a.png", photograph(64, 48, 9))
        done = legs("precompute", scene, "--out", out, "--workers", 1)
        assert done.returncode == 0, done.stderr
        assert f"{7 - kept} made, {kept} up to date, 0 skipped" in done.stdout
        assert WeightStore(out).check() == ([], [])
        assert not list(out.glob(".writing-*"))

    @pytest.mark.slow
    @pytest.mark.parametrize("workers", [1, 3])
    def test_ctrl_c_keeps_what_is_done(self, scene, out, workers):
        process = self.start(scene, out, workers)
        os.killpg(process.pid, signal.SIGINT)  # a terminal sends it to every process
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 130, errors
        assert b"Traceback" not in errors
        store = WeightStore(out)
        assert 1 <= len(store.entries) <= 6
        assert store.check() == ([], [])
        self.finish(scene, out, len(store.entries))

    @pytest.mark.slow
    def test_killed_it_goes_on_where_it_was_and_its_workers_end(self, scene, out):
        process = self.start(scene, out, 3)
        workers = children(process.pid)
        assert len(workers) >= 3
        process.kill()
        process.wait()
        wait_until(lambda: not any(alive(worker) for worker in workers))
        store = WeightStore(out)
        assert 1 <= len(store.entries) <= 6
        assert store.check()[0] == []
        self.finish(scene, out, len(store.entries))

    @pytest.mark.slow
    def test_a_killed_worker_costs_one_photograph(self, scene, out):
        process = self.start(scene, out, 3)
        wait_until(lambda: len(workers_of(process.pid)) == 1)  # the one that waits
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        _, errors = process.communicate(timeout=60)
        assert process.returncode == 1
        assert errors.count(b"legs: skipped") == 1
        assert b"5a.png: its process was killed" in errors
        self.finish(scene, out, 6)


def wait_until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def workers_of(pid):
    return [child for child in children(pid) if b"spawn_main" in command_line(child)]


def children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def command_line(pid):
    return Path(f"/proc/{pid}/cmdline").read_bytes()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
