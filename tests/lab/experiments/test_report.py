"""`legs report`: the page by itself, and in a real browser where there is one (Debian: apt-get install chromium)."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, Iterator, List

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss import LegsError
from legs_loss.cli import main

pytest.importorskip("numba")
pytest.importorskip("scipy")
pytest.importorskip("matplotlib")

from legs_loss.lab.experiments.arms import parse_arms
from legs_loss.lab.experiments.running import Comparison, read_rows
from legs_loss.lab.report import html as report
from legs_loss.lab.report.html_pictures import FORMATS, DrawnView, differing, draw_row, encode
from legs_loss.lab.training.dataset import TrainingView, load_view, split_views
from legs_loss.lab.training.trainer import TrainConfig
from legs_loss.scenes import read_scene
from legs_loss.weights import weight_map
from tests.lab.training import train_one

ARMS = ("3dgs", "legs", "legs:scale", "legs:shuffled")


@pytest.fixture(scope="module")
def comparison(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared")
    trainings = Comparison(tiny_scene, TrainConfig(iterations=30, resolution=1), out)
    for arm in parse_arms(ARMS):
        for seed in (0, 1):
            train_one(trainings, arm, seed)
    return out


@pytest.fixture(scope="module")
def page_path(comparison: Path) -> Path:
    assert main(["report", str(comparison)]) == 0
    return comparison / "report.html"


def test_the_page_needs_nothing_else(page_path: Path, comparison: Path, tiny_scene: Path) -> None:
    text = page_path.read_text(encoding="utf-8")
    assert len(text) < report.LIMIT
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:|#)|@import|url\((?!#)|fetch\(""", text)
    for arm in ARMS:
        assert f'<th scope="row">{arm}</th>' in text
    settings = read_rows(comparison)[0]
    assert settings["scene"]["sha256"] in text
    assert "its loss is" in text and "torch" in text
    assert f"legs compare {tiny_scene} --arms legs legs:scale legs:shuffled --seeds 2 -r 1 --iterations 30" in text
    assert text.count("Too short to decide: 30 iterations. Differences are given from 500 iterations on.") == 2
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(set(ids)) == len(ids)
    assert "#222222" not in text  # plots take the page's ink


def test_pictures_are_the_arms_own(comparison: Path, tiny_scene: Path) -> None:
    rows = {(row["arm"], row["seed"]): row for row in read_rows(comparison)[1]}
    scene = read_scene(tiny_scene)
    view = load_view(scene, split_views(scene)[1][0], 1)
    arms = {arm.name: arm for arm in parse_arms(ARMS)}
    drawn = {name: draw_row(rows[name, 0], comparison / arm.folder / "seed-0", view) for name, arm in arms.items()}
    for name, one in drawn.items():
        mse = float((one.rendering - view.image).double().square().mean())
        expected = rows[name, 0]["metrics"]["views"]["test"][view.name]["psnr"]
        assert -10 * np.log10(mse) == pytest.approx(expected, abs=1e-3)
    legs = weight_map(view.image, "legs")
    assert torch.equal(drawn["3dgs"].weight, torch.ones_like(legs))
    assert torch.equal(drawn["legs"].weight, legs)
    assert torch.allclose(drawn["legs:scale"].weight, torch.tensor(rows["legs:scale", 0]["config"]["l1_scale"]))
    assert torch.equal(drawn["legs:shuffled"].weight.flatten().sort().values, legs.flatten().sort().values)


def test_a_mask_darkens_the_photograph_and_hides_errors(comparison: Path, tiny_scene: Path) -> None:
    scene = read_scene(tiny_scene)
    view = load_view(scene, split_views(scene)[1][0], 1)
    mask = torch.ones(1, *view.image.shape[1:])
    mask[..., :16] = 0
    drawn = {"3dgs": DrawnView((view.image + 0.5).clamp(0, 1), torch.ones_like(mask))}

    def pixels(view: TrainingView, arm: str, kind: str) -> np.ndarray:
        uri = encode(view, drawn, FORMATS[0]).images[arm][kind]
        return np.array(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2])))).astype(float)

    plain, masked = (pixels(one, "photograph", "rendering") for one in (view, replace(view, mask=mask)))
    np.testing.assert_allclose(masked[:, :16], plain[:, :16] / 4, atol=1)
    np.testing.assert_array_equal(masked[:, 16:], plain[:, 16:])
    error = pixels(replace(view, mask=mask), "3dgs", "error")
    assert np.ptp(error[:, :16], axis=(0, 1)).max() == 0 and error[:, :16].sum() < error[:, 16:32].sum()


def test_crops_are_where_errors_differ() -> None:
    difference = torch.zeros(40, 60)
    difference[5:15, 40:50] = 1.0
    difference[30:40, 0:10] = -2.0
    assert differing(difference, 3) == [[0, 30, 10, 10], [40, 5, 10, 10]]
    assert differing(torch.zeros(40, 60)) == []


def test_a_page_that_would_be_too_large(page_path: Path, comparison: Path, tmp_path: Path, monkeypatch: Any) -> None:
    size = page_path.stat().st_size
    monkeypatch.setattr(report, "LIMIT", size - 1000)
    path = report.write_report(comparison, tmp_path / "smaller.html")
    images = re.findall(r"data:image/(\w+);base64,([^\"]+)", path.read_text(encoding="utf-8"))
    assert {kind for kind, _ in images} == {"jpeg"}
    from PIL import Image

    assert Image.open(io.BytesIO(base64.b64decode(images[0][1]))).size == (64, 48)
    monkeypatch.setattr(report, "LIMIT", 1000)
    with pytest.raises(LegsError, match="choose fewer --views or --arms"):
        report.write_report(comparison, tmp_path / "none.html")
    assert not (tmp_path / "none.html").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--views", "nowhere"], "no view has 'nowhere' in its name"),
        (["--arms", "eggs"], "no row of the arm eggs is trained"),
        (["--scene", "/nowhere/at/all"], "the scene is not there"),
    ],
)
def test_mistakes(arguments: List[str], says: str, comparison: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["report", str(comparison), "-o", str(tmp_path / "a.html"), *arguments]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "a.html").exists()
    assert main(["report", str(tmp_path)]) == 2
    assert "no comparison here" in capsys.readouterr().err


def test_another_scene_and_a_place_that_cannot_be_written(
    comparison: Path, tiny_scene: Path, tmp_path: Path, capsys: Any
) -> None:
    other = shutil.copytree(str(tiny_scene), str(tmp_path / "other"))
    points = Path(other) / "sparse" / "0" / "points3D.bin"
    data = bytearray(points.read_bytes())
    data[20] ^= 1
    points.write_bytes(bytes(data))
    assert main(["report", str(comparison), "--scene", other, "-o", str(tmp_path / "a.html")]) == 2
    assert "not the scene of the comparison" in capsys.readouterr().err
    for place in (tmp_path, points / "a.html"):
        assert main(["report", str(comparison), "-o", str(place)]) == 2
        assert f"cannot write {place}" in capsys.readouterr().err


# In a browser


@pytest.fixture(params=["light", "dark"])
def page(request: Any, browser: Any, page_path: Path) -> Iterator[Any]:
    context = browser.new_context(color_scheme=request.param, viewport={"width": 1280, "height": 900}, offline=True)
    page = context.new_page()
    troubles: List[str] = []
    page.on("console", lambda message: troubles.append(message.text))
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("request", lambda asked: troubles.extend([asked.url] if asked.url.startswith("http") else []))
    page.goto(page_path.as_uri())
    yield page
    context.close()
    assert not troubles


def clip(page: Any) -> str:
    return page.evaluate("getComputedStyle(document.getElementById('over')).clipPath")


def test_the_slider_moves_by_key_and_by_mouse(page: Any) -> None:
    slider = page.get_by_role("slider", name="Wipe between the left and the right method")
    assert clip(page) == "inset(0px 0px 0px 50%)"
    slider.focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    assert clip(page) == "inset(0px 0px 0px 60%)"
    assert slider.get_attribute("aria-valuetext") == "60% 3dgs, the rest legs"
    page.keyboard.press("Home")
    assert clip(page) == "inset(0px 0px 0px 0%)"
    box = slider.bounding_box()
    page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + box["height"] / 2)
    assert 20 <= int(slider.input_value()) <= 30
    assert clip(page) == f"inset(0px 0px 0px {slider.input_value()}%)"
    page.locator("#wipe").scroll_into_view_if_needed()
    box = page.locator("#wipe").bounding_box()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 30)
    assert slider.input_value() != "30"  # nothing is pressed
    page.mouse.down()
    assert slider.input_value() == "30"
    page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 40, steps=3)
    page.mouse.up()
    assert clip(page) == "inset(0px 0px 0px 80%)"
    page.mouse.move(box["x"] + 0.1 * box["width"], box["y"] + 40)
    assert slider.input_value() == "80"


def test_what_is_shown_can_be_chosen(page: Any) -> None:
    before = page.locator("#over").get_attribute("src")
    page.get_by_label("right", exact=True).select_option("legs:shuffled")
    over = page.locator("#over")
    assert over.get_attribute("src") != before
    assert "legs:shuffled" in over.get_attribute("alt")
    assert page.locator("#right-name").text_content() == "legs:shuffled"
    page.get_by_label("show", exact=True).select_option("error")
    assert "and more" in page.locator("#scale").text_content()
    page.get_by_label("show", exact=True).select_option("weight")
    assert page.locator("#scale i.viridis").count() == 1
    widths = page.evaluate("[...document.querySelectorAll('.wipe img')].map((one) => one.naturalWidth)")
    assert widths == [64, 64]
    # Each crop is a picture with something on it.
    crops = page.locator("#crops canvas")
    assert crops.count() in (3, 6, 9)
    page.wait_for_function(
        "[...document.querySelectorAll('#crops canvas')].every((one) => "
        "one.getContext('2d').getImageData(0, 0, one.width, one.height).data.some((value, i) => i % 4 === 3 && value))"
    )
    page.get_by_label("left", exact=True).select_option("legs:shuffled")
    assert page.locator("#crops").text_content() == "Choose two different methods."


def test_tables_sort_both_ways(page: Any) -> None:
    table = page.locator("table.sortable").first
    head = table.get_by_role("columnheader", name="Gaussians")

    column = int(head.evaluate("e => e.cellIndex")) + 1

    def values() -> List[float]:
        cells = table.locator(f"tbody td:nth-child({column})")
        return [float(one.partition(" ")[0].replace(",", "")) for one in cells.all_text_contents()]

    start = values()
    head.get_by_role("button").press("Enter")
    assert head.get_attribute("aria-sort") == "descending"
    assert values() == sorted(start, reverse=True)
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert values() == sorted(start)
    first = table.get_by_role("columnheader", name="arm", exact=True)  # the arrow is not read aloud
    first.get_by_role("button").click()
    names = table.locator("tbody th").all_text_contents()
    assert names == sorted(names)
    assert head.get_attribute("aria-sort") is None


def test_everything_has_a_name_and_is_seen(page: Any) -> None:
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll("select, input, button")].filter(
             (one) => !(one.labels && one.labels.length) && !one.getAttribute("aria-label") && !one.textContent.trim()
           ).map((one) => one.outerHTML)"""
    )
    assert unnamed == []
    assert page.evaluate("[...document.images].every((one) => one.alt)")
    assert page.get_by_role("img", name="by number of Gaussians").count() == 2
    ground, ink = page.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
    )
    assert contrast(ground, ink) > 7
    faint = page.evaluate("getComputedStyle(document.querySelector('.faint')).color")
    assert contrast(ground, faint) > 4.5
    dark = page.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
    assert (luminance(ground) < 0.1) == dark
    label = page.evaluate("getComputedStyle(document.querySelector('figure svg text')).fill")
    assert contrast(ground, label) > 7  # the plots' text takes the page's ink


def luminance(colour: str) -> float:
    channels = [int(value) / 255 for value in re.findall(r"\d+", colour)[:3]]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in channels]
    return float(np.dot((0.2126, 0.7152, 0.0722), linear))


def contrast(first: str, second: str) -> float:
    """WCAG's."""
    low, high = sorted((luminance(first), luminance(second)))
    return (high + 0.05) / (low + 0.05)


def test_what_a_stranger_named_is_shown_and_not_run(page_path: Path, comparison: Path) -> None:
    """A row.json may come from anyone: all of it is escaped, and the policy runs the page's own script alone."""
    attack = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    settings, rows = read_rows(comparison)
    for row in rows:
        row["config"]["spec"]["curve"] = row["versions"]["torch"] = f'"{attack}'
    first = {row["arm"]: dict(row, seed=attack) for row in rows}
    named = dict(settings, scene=dict(settings["scene"], name=attack))
    view = report.ViewPictures(attack, 8, 6, {}, 1.0, 1.0, {})
    page = report._page(named, rows, ["3dgs"], [view], first, comparison)
    assert page.count("<script") == 2
    assert "<img src=x" not in page
    assert "&lt;img src=x" in page
    script = page.rpartition("<script>")[2].partition("</script>")[0]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    assert "default-src 'none'" in page_path.read_text(encoding="utf-8")


def test_plots_fit_a_telephone(browser: Any, page_path: Path) -> None:
    page = browser.new_page(viewport={"width": 400, "height": 800}, offline=True)
    page.goto(page_path.as_uri())
    right = page.evaluate(
        "[...document.querySelectorAll('figure svg')].map((one) => one.getBoundingClientRect().right)"
    )
    assert len(right) == 3
    assert max(right) <= 400
    size = page.evaluate("document.querySelector('figure svg text').getBoundingClientRect().height")
    assert size >= 8  # pixels: read without a magnifying glass
    page.close()


def _row(arm: str, seed: int, psnr: float, gaussians: int) -> Dict[str, Any]:
    views = {"test": {"a.png": {"psnr": psnr}, "b.png": {"psnr": psnr + 1}}}
    return {
        "arm": arm,
        "seed": seed,
        "metrics": {"test": {"psnr": psnr + 0.5}, "views": views, "gaussians": gaussians},
    }


def test_the_verdict_is_one_sentence() -> None:
    rows = [_row(arm, seed, 20.0 + seed + gain, count) for seed in range(3) for arm, gain, count in (
        ("3dgs", 0.0, 1000), ("legs", 0.25, 2300), ("legs@3dgs", (-0.5, 0.5, 0.3)[seed], 1000))]  # fmt: skip
    assert report._verdict(rows, ["3dgs", "legs", "legs@3dgs"], "legs") == (
        "legs has 0.25 dB more PSNR than 3dgs on held-out views, with 2.3 times the Gaussians; at the same number of "
        "Gaussians it has no clear difference in PSNR (+0.10 dB, may be chance) to it."
    )
    assert "it was not compared" in report._verdict(rows, ["3dgs", "legs"], "legs")
    assert report._verdict(rows, ["3dgs"], "3dgs").startswith("There is nothing to compare yet")
