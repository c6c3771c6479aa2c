"""`legs masks`, `legs export`, `legs info` and `legs show` with masks, as a user runs them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from legs_loss.cli.shared.sheet import Shown, save_sheet
from legs_loss.spec import PRESETS
from tests import support


def legs(*arguments, code=0):
    done = support.legs(*arguments)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def scene(tmp_path):
    """Two photographs of 60x40: gray noise with a white, a black and a flat part; the other one is noise."""
    generator = np.random.default_rng(0)
    folder = tmp_path / "scene/images/cam"
    folder.mkdir(parents=True)
    for name in ("a", "b"):
        pixels = generator.integers(60, 200, (40, 60, 3), dtype=np.uint8)
        if name == "a":
            pixels[:, :10], pixels[:, 10:20], pixels[:, 20:40] = 255, 0, 128
        Image.fromarray(pixels).save(folder / f"{name}.png")
    return tmp_path / "scene"


def made(scene, name="a"):
    return np.asarray(Image.open(scene / f"masks/cam/{name}.png"))


def test_exposure(scene):
    assert "masks: 2 masks, 0 skipped" in legs("masks", scene, "--from", "saturated", "dark")
    expected = np.full((40, 60), 255)
    expected[:, :20] = 0
    np.testing.assert_array_equal(made(scene), expected)
    assert made(scene, "b").min() == 255
    assert "masks is not empty" in legs("masks", scene, "--from", "dark", code=2)


def test_sharpness_leaves_out_what_has_no_contrast(scene):
    legs("masks", scene, "--from", "sharpness")
    assert made(scene)[:, 26:34].max() == 0 and made(scene)[:, 44:].min() == 255


def test_a_folder_of_masks_and_what_masks_everything(scene, tmp_path):
    (tmp_path / "mine").mkdir()
    for name, value in (("a", 255), ("b", 0)):
        Image.fromarray(np.full((20, 30), value, np.uint8)).save(tmp_path / f"mine/{name}.png")
    said = legs("masks", scene, "--from", tmp_path / "mine", "dark", code=1)
    assert "skipped images/cam/b.png: nothing of it would count" in said and "1 masks, 1 skipped" in said
    assert made(scene)[0].tolist() == [255] * 10 + [0] * 10 + [255] * 40
    assert "there is no folder or file nowhere" in legs(
        "masks", scene, "--from", "nowhere", "--out", tmp_path / "new", code=2
    )


def test_from_masks_to_images_for_other_programs(scene, tmp_path):
    legs("masks", scene, "--from", "saturated", "dark")
    floats = np.full((40, 60), 0.5, np.float32)
    (tmp_path / "mine").mkdir()
    np.save(tmp_path / "mine/a.npy", floats)
    legs("precompute", scene, "--workers", 1, "--masks", "masks", "--weights", tmp_path / "mine")
    said = legs("info", scene)
    assert "mask       2 view(s) of your own" in said and "weights    1 view(s) of your own" in said
    assert "operators  laplacian p=2 eps=1e-08 (2)" in said
    out = tmp_path / "out"
    assert "2 maps; white is a weight of 11" in legs("export", scene, out)
    for folder, most, step in (("weights_8bit", 255, 1), ("weights_16bit", 65535, 8)):
        first, second = (np.asarray(Image.open(out / folder / f"cam/{name}.png")) for name in "ab")
        header = (out / folder / "cam/a.png").read_bytes()[24:26]
        assert tuple(header) == (16 if most > 255 else 8, 0)  # bits, gray: as other programs read it
        assert second.max() == most and first[:, :20].max() == 0
        # Flat, so W = 1, times the user's 0.5, of a largest weight of 11.
        assert abs(int(first[20, 30]) - most * 0.5 / 11) <= step
    np.testing.assert_array_equal(np.asarray(Image.open(out / "masks/cam/a.png")), made(scene))
    assert "is not empty" in legs("export", scene, out, code=2)
    assert "cannot write to" in legs("export", scene, scene / "images/cam/a.png", code=2)
    assert "no manifest.json" in legs("export", tmp_path / "mine", tmp_path / "new", code=2)
    assert not (tmp_path / "new").exists()


def test_a_mostly_masked_view_is_named(scene):
    (scene / "masks").mkdir()
    mask = np.zeros((40, 60), np.uint8)
    mask[:10] = 255
    Image.fromarray(mask).save(scene / "masks/b.png")
    legs("precompute", scene, "--workers", 1, "--masks", "masks")
    assert "masked by more than half: images/cam/b.png" in legs("info", scene)


def test_show_draws_masks_before_there_is_a_store_and_of_the_store(scene, tmp_path):
    pytest.importorskip("matplotlib")
    legs("masks", scene, "--from", "saturated", "dark")

    def drawn(*options):
        legs("show", scene, "--out", tmp_path / "sheet.png", *options)
        with Image.open(tmp_path / "sheet.png") as sheet:
            return np.array(sheet.convert("RGB")).astype(int)

    plain, masked = drawn(), drawn("--masks", "masks")
    assert masked.shape[0] > plain.shape[0]
    legs("precompute", scene, "--workers", 1, "--masks", "masks")
    np.testing.assert_array_equal(drawn(), masked)
    said = legs("show", scene / "legs_weights", "--masks", "masks", code=2)
    assert "a store has the masks that it was made with" in said


def test_the_viewer_darkens_what_a_mask_leaves_out(scene):
    pytest.importorskip("numba")
    from legs_loss.lab.viewer.server import _Cameras
    from legs_loss.scenes import read_scene
    from legs_loss.store import MASK, WeightStore

    legs("masks", scene, "--from", "saturated", "dark")
    legs("precompute", scene, "--workers", 1, "--masks", "masks")
    cameras = object.__new__(_Cameras)
    cameras.store = WeightStore(scene / "legs_weights")
    cameras.masks = {entry.view: entry for entry in cameras.store.of_kind(MASK)}
    picture = cameras._photograph(next(view for view in read_scene(scene).views if view.name.endswith("a.png")))
    width = picture.shape[1]
    assert abs(int(picture[0, 2, 0]) - 255 * 0.25) <= 1  # white, left out
    assert picture[0, width // 2, 0] == 128  # it counts


def test_the_sheet_has_a_row_for_the_mask(tmp_path):
    pytest.importorskip("matplotlib")
    view = np.linspace(0, 1, 600, dtype=np.float32).reshape(20, 30)
    sizes = []
    for mask in (1.0, (view > 0.5).astype(np.float32)):
        views = [Shown("a", None, view, mask), Shown("b", None, view, 1.0, 2 * view)]
        save_sheet(tmp_path / "sheet.png", views, PRESETS["legs"], "title")
        sizes.append(Image.open(tmp_path / "sheet.png").size[1])
    assert sizes[1] > sizes[0]
