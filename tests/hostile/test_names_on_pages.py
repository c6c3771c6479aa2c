"""Names that are HTML, on the report's page and in the viewer: a browser shows them, runs none and asks for nothing."""

from __future__ import annotations

import json
import shutil

import pytest
import torch

pytest.importorskip("numba")

from PIL import Image

from legs_loss.cli import main
from legs_loss.lab.embedded.colmap_writer import write_colmap
from legs_loss.lab.experiments.arms import parse_arms
from legs_loss.lab.experiments.running import Comparison
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import write_ply
from legs_loss.lab.training.trainer import TrainConfig
from legs_loss.scenes import read_scene
from tests.lab.training import train_one

pytestmark = pytest.mark.slow

RAN = "globalThis.ran=1"
FORMS = [
    f"<img src=x onerror={RAN}>",
    f"<svg onload={RAN}>",
    f"'onmouseover='{RAN}' \"autofocus onfocus=\"{RAN}",
    f"<x<script>{RAN}<",  # before a separator: </script> closes the page's own
    f"{{{RAN}}}{{{{7*7}}}}{{% raw %}}",
    f"![x](x) [y](javascript:{RAN}) <b>bold",
]
ALL = " ".join(FORMS).replace("/", "")
NAMED = f"script><script>{RAN}<"  # behind "<", as the name of a file


@pytest.fixture(scope="module")
def compared(tiny_scene, tmp_path_factory):
    """A comparison of a scene whose folder, photographs, EXIF fields and masks are named so, and its page."""
    folder = tmp_path_factory.mktemp("named")
    scene, original = folder / ALL[:200], read_scene(tiny_scene)
    exif, cameras = Image.Exif(), {}
    for tag in (0x010E, 0x010F, 0x0110, 0x0131, 0x013B, 0x8298):  # description, maker, model, software, artist, rights
        exif[tag] = ALL
    for index, view in enumerate(original.views):
        name = f"{FORMS[index % len(FORMS)].replace('/', '')}<{'/' if index % 2 else ''}{NAMED}{index}.jpg"
        for kind in ("images", "masks"):
            (scene / kind / name).parent.mkdir(parents=True, exist_ok=True)
        with Image.open(str(view.path)) as photograph:
            photograph.save(str(scene / "images" / name), exif=exif, comment=ALL.encode())
            Image.new("L", photograph.size, 255).save(str((scene / "masks" / name).with_suffix(".png")))
        cameras[name] = view.camera
    write_colmap(scene, cameras, original.points)
    assert main(["precompute", str(scene), "--masks", "masks", "-r", "2", "--workers", "1"]) == 0
    out = folder / f"{FORMS[0]} out"
    trainings = Comparison(scene, TrainConfig(iterations=6, resolution=2), out)
    for arm in parse_arms(["3dgs", "legs"]):
        train_one(trainings, arm, 0)
    return scene, out


def said_by_a_stranger(out, attack):
    """Put a text into every text of a comparison that is not checked against a list, and return how many."""
    path, count = out / "comparison.json", 0
    settings = json.loads(path.read_text())
    settings["scene"]["name"] = attack
    path.write_text(json.dumps(settings))
    for row_path in out.rglob("row.json"):
        row = json.loads(row_path.read_text())
        for name in row["versions"]:
            row["versions"][name] = attack
            count += 1
        row_path.write_text(json.dumps(row))
    return count


@pytest.mark.parametrize("attack", [None, " ".join(FORMS), "</script><script>" + RAN + "</script><!-- <script>"])
def test_the_report(attack, compared, tmp_path, browser):
    pytest.importorskip("jinja2")
    scene, made = compared
    out = tmp_path / "out"
    shutil.copytree(str(made), str(out))
    if attack is not None:
        assert said_by_a_stranger(out, attack) > 3
    views = ["--views", *sorted(view.name for view in read_scene(scene).views)[:6]]
    assert main(["report", str(out), "--scene", str(scene), *views]) == 0
    page, asked, said = browser.new_page(), [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("dialog", lambda dialog: said.append(dialog.message))
    page.goto((out / "report.html").as_uri())
    page.mouse.move(300, 300)
    for _ in range(60):  # what takes the focus, and what its change shows
        page.keyboard.press("Tab")
        page.keyboard.press("ArrowRight")
    assert page.evaluate("globalThis.ran") is None
    assert (said, [url for url in asked if not url.startswith(("file:", "data:"))]) == ([], [])
    assert len([url for url in asked if url.startswith("file:")]) == 1, asked
    assert page.evaluate("document.scripts.length") == 2
    attributes = (
        "[...document.querySelectorAll('*')].flatMap(e => e.getAttributeNames()).filter(n => n.startsWith('on'))"
    )
    assert page.evaluate(attributes) == []
    shown = page.inner_text("body") + page.title()
    assert FORMS[0].replace("/", "") in shown and "7*7" in shown and "{49}" not in shown
    page.close()


@pytest.mark.parametrize("name", [" ".join(FORMS[:4]), " ".join(FORMS[4:])])
def test_the_viewer(name, tmp_path, browser):
    pytest.importorskip("viser")
    from legs_loss.lab.viewer.content import find_content
    from legs_loss.lab.viewer.server import serve
    from tests.lab.test_view import free_port

    name = name.replace("/", "")
    for run in (name, "b"):
        path = tmp_path / f"{name} all" / run / "point_cloud" / "iteration_7" / "point_cloud.ply"
        path.parent.mkdir(parents=True)
        write_ply(path, Gaussians.from_points(torch.rand(50, 3), torch.rand(50, 3), sh_degree=0, opacity=0.9))
    server, address = serve(find_content(tmp_path / f"{name} all"), "legs", "127.0.0.1", free_port())
    page, asked = browser.new_page(), []
    page.on("request", lambda request: asked.append(request.url))
    try:
        page.goto(address)
        page.get_by_text("50 Gaussians").first.wait_for(timeout=60_000)
        page.get_by_text(f"{name} all", exact=True).first.wait_for(timeout=10_000)  # the title, letter for letter
        assert page.evaluate("globalThis.ran") is None
        assert name in page.inner_text("body")
        assert page.locator("b, a[href^=javascript], img[src=x]").count() == 0
        here = address.split("?")[0]
        assert [url for url in asked if not url.startswith((here, "data:", "blob:"))] == []
        assert not [url for url in asked if url.rstrip("/").endswith("/x")]
    finally:
        page.close()
        server.stop()
