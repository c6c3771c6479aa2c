"""``legs view`` in a real browser: the picture, the effect of each switch, and no error."""

from __future__ import annotations

import io
import json
import shutil
import signal
import socket
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss import LegsError
from legs_loss.cli import main
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import write_ply
from legs_loss.lab.viewer.content import find_content
from legs_loss.lab.viewer.server import left_of, splats
from legs_loss.scenes import read_scene
from tests.support import legs_command, legs_environment


def some(colour, count=400):
    """Gaussians of one colour on a grid in front of a camera at the origin that looks along z."""
    side = int(count**0.5)
    x, y = torch.meshgrid(torch.linspace(-1, 1, side), torch.linspace(-1, 1, side), indexing="ij")
    xyz = torch.stack([x.flatten(), y.flatten(), torch.full((side * side,), 3.0)], 1)
    rgb = torch.tensor([colour]).repeat(side * side, 1)
    made = Gaussians.from_points(xyz, rgb, sh_degree=3, opacity=0.99)
    made.log_scales = torch.full_like(made.log_scales, -2.5)
    return made


@pytest.fixture
def runs(tmp_path):
    for name, colour in (("red", (255, 0, 0)), ("green", (0, 255, 0))):
        for iteration in (30, 7000):
            path = tmp_path / "runs" / name / "point_cloud" / f"iteration_{iteration}" / "point_cloud.ply"
            write_ply(path, some(colour, 400 if iteration == 7000 else 4))
    return tmp_path / "runs"


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


class TestContent:
    def test_a_ply_a_run_and_several_runs(self, runs):
        last = runs / "red" / "point_cloud" / "iteration_7000" / "point_cloud.ply"
        assert find_content(last).methods == {"point_cloud": last}
        assert find_content(runs / "red").methods == {"red": last}
        assert list(find_content(runs).methods) == ["green", "red"]

    def test_a_scene_is_read_where_it_is_given(self, runs, tiny_scene):
        assert find_content(runs).scene is None
        assert len(find_content(runs, tiny_scene).scene.views) == len(read_scene(tiny_scene).views)

    def test_a_demo_has_its_scene_beside_the_runs(self, runs, tiny_scene):
        shutil.copytree(str(tiny_scene), str(runs / "scene"))
        found = find_content(runs)
        assert list(found.methods) == ["green", "red"]
        assert len(found.scene.views) == len(read_scene(tiny_scene).views)

    def test_what_holds_none(self, tmp_path):
        with pytest.raises(LegsError, match="holds no Gaussians"):
            find_content(tmp_path)
        with pytest.raises(LegsError, match="there is no file or folder"):
            find_content(tmp_path / "absent.ply")


class TestSplats:
    def test_covariance_and_colour_by_hand(self):
        half = 0.5**0.5
        gaussians = Gaussians(
            means=torch.zeros(1, 3),
            log_scales=torch.log(torch.tensor([[1.0, 2.0, 3.0]])),
            quaternions=torch.tensor([[half, 0.0, 0.0, half]]) * 4,  # a quarter turn about z: x and y change places
            opacity_logits=torch.zeros(1, 1),
            sh=torch.zeros(1, 4, 3),
        )
        one = splats(gaussians)
        assert np.allclose(one.covariances[0], np.diag([4.0, 1.0, 9.0]), atol=1e-5)
        assert np.allclose(one.rgbs, 0.5)
        assert np.allclose(one.opacities, 0.5)

    def test_a_line_on_the_screen(self):
        points = np.array([[-1.0, 0.0, 1.0], [0.2, 0.0, 1.0], [1.0, 0.0, 1.0]])
        view = np.eye(3), np.zeros(3), np.pi / 2, 1.0  # x / z from -1 to 1 fills the screen
        assert left_of(points, *view, 0.5).tolist() == [True, False, False]
        assert left_of(points, *view, 0.7).tolist() == [True, True, False]
        turned = np.diag([-1.0, -1.0, 1.0])  # upside down: left is right
        assert left_of(points, turned, *view[1:], 0.5).tolist() == [False, True, True]


@pytest.mark.slow
class TestBrowser:
    @pytest.fixture
    def page(self):
        pytest.importorskip("viser")
        playwright = pytest.importorskip("playwright.sync_api")
        chromium = shutil.which("chromium")
        if chromium is None:
            pytest.skip("no Chromium here")
        with playwright.sync_playwright() as started:
            options = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
            browser = started.chromium.launch(executable_path=chromium, args=options)
            page = browser.new_page(viewport={"width": 1000, "height": 600})
            page.errors = []
            page.on("pageerror", lambda error: page.errors.append(str(error)))
            page.on("console", lambda message: page.errors.append(message.text) if message.type == "error" else None)
            yield page
            browser.close()

    def shot(self, page):
        return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)

    def coloured(self, page):
        """Return masks of the clearly red and the clearly green pixels left of the panel."""
        picture = self.shot(page)[:, :600]
        return picture[..., 0] > picture[..., 1] + 80, picture[..., 1] > picture[..., 0] + 80

    def shares(self, page):
        red, green = self.coloured(page)
        return red.mean(), green.mean()

    def errors(self, page):
        """Return the page's errors, without that of viser's own flat splat, which has no bounding sphere."""
        return [error for error in page.errors if "Computed radius is NaN" not in error]

    def until(self, page, holds):
        for _ in range(120):
            if holds():
                return
            page.wait_for_timeout(500)
        pytest.fail(f"red and green: {self.shares(page)}; errors: {page.errors}")

    def test_the_panel_folds_on_a_narrow_screen(self, page, runs, tiny_scene):
        from legs_loss.lab.viewer.server import serve

        server, address = serve(find_content(runs / "red", tiny_scene), port=free_port())
        try:
            page.set_viewport_size({"width": 400, "height": 700})
            page.goto(address)
            label = page.locator("text=red: 400 Gaussians").first
            label.wait_for(timeout=60_000)
            assert 0 <= label.bounding_box()["x"] < 400
            page.locator("text=Connected").first.click()
            label.wait_for(state="hidden")
        finally:
            server.stop()

    def test_cameras_show_photographs_and_weight_maps(self, page, runs, tiny_scene):
        from legs_loss.lab.viewer.server import serve

        server, address = serve(find_content(runs / "red", tiny_scene), port=free_port())
        try:
            page.goto(address)
            page.wait_for_selector("text=red: 400 Gaussians", timeout=60_000)
            shots = [self.shot(page)]
            for what in ("photograph", "weight map"):
                page.get_by_role("combobox", name="cameras").click()
                page.get_by_role("option", name=what).click()
                before = shots[-1]
                self.until(page, lambda before=before: np.abs(self.shot(page) - before)[:, :600].mean() > 0.5)
                page.wait_for_timeout(1500)
                shots.append(self.shot(page))
            assert np.abs(shots[1] - shots[2])[:, :600].mean() > 0.2
            assert self.errors(page) == []
        finally:
            server.stop()

    def test_methods_are_drawn_toggled_and_wiped(self, page, runs):
        from legs_loss.lab.viewer.server import serve

        server, address = serve(find_content(runs), port=free_port())
        try:
            page.goto(address)
            page.wait_for_selector("text=green: 400 Gaussians", timeout=60_000)
            self.until(page, lambda: self.shares(page)[1] > 0.1 and self.shares(page)[0] < 0.02)
            page.get_by_text("red: 400 Gaussians").click()
            page.get_by_text("green: 400 Gaussians").click()
            self.until(page, lambda: self.shares(page)[0] > 0.1 and self.shares(page)[1] < 0.02)
            page.get_by_text("wipe between two").click()
            self.until(page, lambda: min(self.shares(page)) > 0.05)
            red, green = self.coloured(page)
            assert green.nonzero()[1].mean() < red.nonzero()[1].mean() - 50  # green is left of the line
            assert self.errors(page) == []
        finally:
            server.stop()

    def test_the_command_opens_a_comparison_until_ctrl_c(self, page, tiny_scene, tmp_path):
        pytest.importorskip("numba")
        out = tmp_path / "out"
        arguments = ["compare", tiny_scene, "--out", out, "--arms", "legs", "--seeds", 1, "--iterations", 20]
        assert main([str(argument) for argument in [*arguments, "-r", 2, "--processes", 1]]) == 0
        rows = [json.loads(path.read_text()) for path in sorted(out.glob("*/seed-0/row.json"))]
        assert [row["arm"] for row in rows] == ["3dgs", "legs"]
        command = legs_command("view", out, "--port", free_port())
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        view = subprocess.Popen(command, env=legs_environment(), **pipes)
        try:
            said = view.stdout.readline()
            assert said.endswith("(Ctrl-C ends)\n")
            assert said.startswith("3dgs, legs: http://127.0.0.1:")
            page.goto(said.split()[2])
            for row in rows:
                label = f"{row['arm']}: {row['metrics']['gaussians']:,} Gaussians"
                page.wait_for_selector(f"text={label}", timeout=60_000)
            blank = np.full(3, 255)
            self.until(page, lambda: (self.shot(page)[:, :600] != blank).any(axis=-1).mean() > 0.1)
            before = self.shot(page)[:, :600]
            page.get_by_text("3dgs: ").click()  # nothing is shown any more
            self.until(page, lambda: np.abs(self.shot(page)[:, :600] - before).mean() > 5)
            assert self.errors(page) == []
            view.send_signal(signal.SIGINT)
            _, errors = view.communicate(timeout=60)
            assert view.returncode == 130
            assert errors.splitlines() == ["legs: interrupted"]
        finally:
            view.kill()
            view.wait()


class TestTensorboard:
    @pytest.fixture
    def scalars(self, tmp_path):
        pytest.importorskip("numba")
        pytest.importorskip("tensorboard")
        from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

        def read(run):
            events = EventAccumulator(str(tmp_path / "board" / run))
            events.Reload()
            return {tag: [(one.step, one.value) for one in events.Scalars(tag)] for tag in events.Tags()["scalars"]}

        return read

    def test_a_training(self, tmp_path, tiny_scene, scalars):
        arguments = [
            "train",
            tiny_scene,
            "-m",
            tmp_path / "run",
            "--iterations",
            20,
            "--tensorboard",
            tmp_path / "board",
        ]
        assert main([str(argument) for argument in arguments]) == 0
        found = scalars("run")
        assert set(found) == {"loss", "psnr", "gaussians"}
        last = json.loads((tmp_path / "run" / "metrics.json").read_text())["gaussians"]
        assert [step for step, _ in found["gaussians"]] == [10, 20]
        assert found["gaussians"][-1][1] == last

    def test_a_comparison_has_a_run_for_each_training(self, tmp_path, tiny_scene, scalars):
        arguments = ["compare", tiny_scene, "--out", tmp_path / "out", "--tensorboard", tmp_path / "board"]
        arguments += ["--arms", "3dgs", "legs", "--seeds", 1, "--iterations", 20, "-r", 2, "--processes", 1]
        assert main([str(argument) for argument in arguments]) == 0
        runs = {path.name: scalars(path.name) for path in (tmp_path / "board").iterdir()}
        assert len(runs) == 2
        for found in runs.values():
            assert set(found) == {"loss", "psnr", "gaussians"}
            assert [step for step, _ in found["loss"]] == [10, 20]
        plain, legs = (next(found for name, found in runs.items() if name.startswith(arm)) for arm in ("3dgs", "legs"))
        assert legs["loss"][0][1] > plain["loss"][0][1]  # the same rendering at first, its error weighted
