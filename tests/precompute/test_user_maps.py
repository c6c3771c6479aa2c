"""Masks and weights of the user's own: `legs precompute --masks --weights` on real files, hostile ones among them."""

from __future__ import annotations

import json
import os
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from legs_loss import LegsError, WeightSpec
from legs_loss.precompute import UserMaps, precompute
from legs_loss.scenes import image_tensor, load_training_image, read_scene
from legs_loss.store import MASK, WEIGHTS, WeightStore
from tests.support import legs

SPEC = WeightSpec()


@pytest.fixture
def scene(tmp_path):
    """Three photographs of 12x8, and a mask of the first: its left third does not count."""
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    generator = np.random.default_rng(0)
    for name in ("a", "b", "c"):
        Image.fromarray(generator.integers(0, 256, (8, 12, 3), dtype=np.uint8)).save(tmp_path / f"images/{name}.png")
    Image.fromarray(third()).save(tmp_path / "masks/a.png")
    return tmp_path


def third(dtype=np.uint8, white=255):
    mask = np.full((8, 12), white, dtype)
    mask[:, :4] = 0
    return mask


def mask_of(scene, name="images/a.png", kind=MASK, **settings):
    """Return the map that a run finds by the very image, None if it has none."""
    precompute(read_scene(scene), maps=UserMaps(**{"masks": "masks", **settings}))
    store = WeightStore(scene / "legs_weights")
    view = next(view for view in read_scene(scene, "images").views if view.name == name)
    found = store.find_image(image_tensor(load_training_image(view)), SPEC)
    entry = found.mask if kind == MASK else found.weights
    return None if entry is None else store.user_map(entry)


def replace_mask(scene, image, name="a.png", **options):
    (scene / "masks/a.png").unlink()
    image.save(scene / "masks" / name, **options)


class TestReading:
    def test_a_mask_is_found_by_its_photograph_and_others_count_whole(self, scene):
        np.testing.assert_array_equal(mask_of(scene), third() / 255)
        assert mask_of(scene, "images/b.png") is None
        report = precompute(read_scene(scene), maps=UserMaps("masks"))
        assert (report.user_maps, len(report.kept)) == ({MASK: 1}, 3)
        assert report.notes == ["counted whole, without a mask: images/b.png, images/c.png"]

    @pytest.mark.parametrize("name", ["a.png.png", "images/a.png", "a.tif", "a.bmp"])
    def test_the_names_of_colmap_nerfstudio_and_folders(self, scene, name):
        (scene / "masks/images").mkdir()
        replace_mask(scene, Image.fromarray(third()), name)
        np.testing.assert_array_equal(mask_of(scene), third() / 255)

    @pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA", "LA", "CMYK", "I", "I;16"])
    def test_every_kind_of_pixel(self, scene, mode):
        if mode.startswith("I"):
            image = (
                Image.fromarray(third(np.uint16, 65535)) if mode == "I;16" else Image.fromarray(third(np.int32, 65535))
            )
        else:
            image = Image.fromarray(third()).convert("RGB" if mode == "CMYK" else mode)
            image = image.convert(mode)
        replace_mask(scene, image, "a.tif" if mode in ("CMYK", "I") else "a.png")
        np.testing.assert_array_equal(mask_of(scene), third() / 255)

    def test_what_is_transparent_does_not_count(self, scene):
        pixels = np.full((8, 12, 4), 255, np.uint8)
        pixels[:, :4, 3] = 0
        replace_mask(scene, Image.fromarray(pixels))
        np.testing.assert_array_equal(mask_of(scene), third() / 255)

    def test_exif_does_not_turn_it_as_it_does_not_turn_photographs(self, scene):
        exif = Image.Exif()
        exif[0x0112] = 6
        replace_mask(scene, Image.fromarray(third()), exif=exif)
        np.testing.assert_array_equal(mask_of(scene), third() / 255)

    def test_a_palette_is_read_as_its_gray_values_not_as_its_indices(self, scene):
        image = Image.fromarray((third() == 0).astype(np.uint8), "P")  # index 0 is white, 1 black
        image.putpalette([255, 255, 255, 0, 0, 0])
        replace_mask(scene, image)
        np.testing.assert_array_equal(mask_of(scene), third() / 255)
        replace_mask(scene, image, transparency=0)  # nothing but the black is left
        with pytest.raises(LegsError, match="all black"):
            mask_of(scene)

    @pytest.mark.parametrize(("kind", "mode"), [(np.uint8, None), (np.uint16, None), (np.uint8, "RGB")])
    def test_zeros_and_ones_are_black_and_white(self, scene, kind, mode):
        image = Image.fromarray(third(kind, 1))
        replace_mask(scene, image if mode is None else image.convert(mode))
        np.testing.assert_array_equal(mask_of(scene), third() / 255)

    def test_those_of_no_photograph_are_named_and_left_out(self, scene):
        Image.fromarray(third()).save(scene / "masks/z.png")
        report = precompute(read_scene(scene), maps=UserMaps("masks"))
        assert report.user_maps == {MASK: 1} and len(report.notes) == 2
        assert "1 file(s) are left out" in report.notes[0] and str(scene / "masks/z.png") in report.notes[0]

    def test_one_for_all(self, scene):
        os.replace(scene / "masks/a.png", scene / "all.png")
        for name in ("a", "b", "c"):
            np.testing.assert_array_equal(mask_of(scene, f"images/{name}.png", masks="all.png"), third() / 255)

    def test_one_for_all_beside_the_photographs_is_none_of_them(self, scene):
        Image.fromarray(third()).save(scene / "images/all.png")
        report = precompute(read_scene(scene), maps=UserMaps("images/all.png"))
        assert (len(report.made), report.user_maps) == (3, {MASK: 3})

    def test_those_that_transforms_json_names_are_used_or_spoken_of(self, scene):
        pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
        frames = [{"file_path": f"images/{name}.png", "transform_matrix": pose} for name in ("a", "b")]
        frames[0]["mask_path"] = "masks/a.png"
        (scene / "transforms.json").write_text(json.dumps({"fl_x": 9, "w": 12, "h": 8, "frames": frames}))
        report = precompute(read_scene(scene))
        assert "masks of 1 photograph(s): --masks mask_path applies them" in report.notes[0]
        report = precompute(read_scene(scene), maps=UserMaps("mask_path"))
        assert (report.user_maps, report.notes) == ({MASK: 1}, ["counted whole, without a mask: images/b.png"])
        np.testing.assert_array_equal(mask_of(scene, masks="mask_path"), third() / 255)

    def test_gray_counts_in_part(self, scene):
        replace_mask(scene, Image.fromarray(np.full((8, 12), 51, np.uint8)))
        np.testing.assert_allclose(mask_of(scene), 0.2, atol=1e-4)

    def test_sizes_follow_the_training_by_the_mean_over_areas(self, scene):
        checks = np.zeros((16, 24), np.uint8)  # twice the photograph's size
        checks[:, ::4] = 255
        replace_mask(scene, Image.fromarray(checks))
        precompute(read_scene(scene), resolution=2, maps=UserMaps("masks"))
        (entry,) = WeightStore(scene / "legs_weights").of_kind(MASK)
        assert (entry.width, entry.height) == (6, 4)
        np.testing.assert_allclose(WeightStore(scene / "legs_weights").user_map(entry), 0.25)

    def test_the_photographs_own_alpha(self, scene):
        image = Image.open(scene / "images/a.png").convert("RGBA")
        image.putalpha(Image.fromarray(third()))
        image.save(scene / "images/a.png")
        np.testing.assert_array_equal(mask_of(scene, masks="alpha"), third() / 255)
        for name in "a":
            Image.open(scene / f"images/{name}.png").convert("RGB").save(scene / f"images/{name}.png")
        with pytest.raises(LegsError, match="none of the 3 photographs has an alpha channel"):
            mask_of(scene, masks="alpha")

    def test_masks_in_a_folder_of_photographs_are_no_photographs(self, scene):
        for path in (scene / "images").iterdir():
            path.rename(scene / path.name)
        (scene / "images").rmdir()
        report = precompute(read_scene(scene), maps=UserMaps("masks"))
        assert sorted(report.made) == ["a.png", "b.png", "c.png"] and report.user_maps == {MASK: 1}

    def test_weights_are_values_times_the_scale(self, scene):
        (scene / "mine").mkdir()
        Image.fromarray(third(np.uint16, 13107)).save(scene / "mine/a.png")
        floats = np.linspace(0, 7, 96, dtype=np.float32).reshape(8, 12)
        np.save(scene / "mine/b.npy", floats)
        found = mask_of(scene, kind=WEIGHTS, weights="mine", scale=10.0)
        np.testing.assert_allclose(found, 2.0 * third() / 255, rtol=1e-3)
        found = mask_of(scene, "images/b.png", WEIGHTS, weights="mine", scale=2.0)
        np.testing.assert_allclose(found, 2 * floats, rtol=1e-3, atol=1e-3)


def png_of(width, height):
    """Return a PNG whose header speaks of a size that its few bytes do not hold."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")


class TestRefused:
    """A mask that cannot be used is one clear line, and nothing is written."""

    def refuse(self, scene, message, **settings):
        with pytest.raises(LegsError, match=message) as caught:
            precompute(read_scene(scene), maps=UserMaps(**{"masks": "masks", **settings}))
        assert "\n" not in str(caught.value)
        assert not (scene / "legs_weights").exists()

    def put(self, scene, data):
        (scene / "masks/b.png").write_bytes(data)

    def test_of_another_shape(self, scene):
        Image.fromarray(third().T).save(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: 8x12 pixels do not have the ratio of sides of its photograph, 12x8")

    def test_all_black(self, scene):
        Image.fromarray(0 * third()).save(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: all black: nothing of its photograph would count")

    def test_labels_are_no_mask(self, scene):
        Image.fromarray(third(white=3)).save(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: no pixel is lighter than 3 of 255: in a mask white counts")

    def test_mask_path_of_a_scene_without(self, scene):
        self.refuse(scene, r"mask_path: no transforms\.json names one", masks="mask_path")

    def test_in_colour(self, scene):
        Image.open(scene / "images/b.png").save(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: in colour, and a map is gray")

    def test_labels_in_a_palette(self, scene):
        labels = Image.fromarray(third() // 255, "P")
        labels.putpalette([0, 0, 0, 128, 0, 0])  # what segmentation programs write: black, dark red
        labels.save(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: in colour, and a map is gray")

    def test_of_another_depth(self, scene):
        for pixels, message in ((third(np.int32, 70000), "more than 16 bits"), (third(np.float32, 1.0), "float")):
            Image.fromarray(pixels).save(scene / "masks/b.tif")
            self.refuse(scene, rf"b\.tif: .*{message}")

    def test_drawn_on_a_photograph_that_exif_turns(self, scene):
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.open(scene / "images/b.png").convert("RGB").save(scene / "images/b.png", exif=exif)
        Image.fromarray(third().T).save(scene / "masks/b.png")  # as a paint program shows it
        self.refuse(scene, r"b\.png: 8x12 pixels do not have the ratio of sides of its photograph, 12x8")

    def test_of_no_photograph(self, scene):
        os.replace(scene / "masks/a.png", scene / "masks/z.png")
        self.refuse(scene, r"z\.png belongs to no photograph: a map has the name")

    def test_two_of_one_photograph(self, scene):
        Image.fromarray(third()).save(scene / "masks/a.png.png")
        self.refuse(scene, r"a\.png and .*a\.png\.png are both maps of images/a\.png")

    def test_of_two_photographs(self, scene):
        (scene / "images/other").mkdir()
        Image.open(scene / "images/b.png").save(scene / "images/other/a.png")
        self.refuse(scene, r"a\.png fits 2 photographs: images/a\.png, images/other/a\.png")

    def test_without_any(self, scene):
        (scene / "masks/a.png").unlink()
        self.refuse(scene, r"masks: no map of a photograph \(\.png")
        self.refuse(scene, "there is no folder or file nowhere", masks="nowhere")

    def test_damaged_files(self, scene):
        whole = (scene / "masks/a.png").read_bytes()
        for data in (b"", b"not an image", whole[:-30], png_of(12, 8)):
            self.put(scene, data)
            self.refuse(scene, r"b\.png: ")

    def test_bombs(self, scene):
        self.put(scene, png_of(12 << 14, 8 << 14))
        self.refuse(scene, r"b\.png: .*(bomb|exceeds)")

    def test_links_and_pipes(self, scene):
        (scene / "masks/b.png").symlink_to(scene / "masks/b.png")
        self.refuse(scene, r"b\.png")
        (scene / "masks/b.png").unlink()
        (scene / "masks/b.png").symlink_to("/dev/zero")
        self.refuse(scene, r"b\.png: .*not a regular file")
        (scene / "masks/b.png").unlink()
        os.mkfifo(scene / "masks/b.png")
        self.refuse(scene, r"b\.png: .*not a regular file")

    def test_folders_and_links_to_them(self, scene):
        (scene / "masks/b.png").mkdir()
        (scene / "masks/images").symlink_to(scene / "masks")  # links to folders are not followed: it has a.png, too
        (scene / "masks/c.png").symlink_to(scene / "masks/a.png")  # links to files are
        assert mask_of(scene, "images/b.png") is None
        np.testing.assert_array_equal(mask_of(scene, "images/c.png"), third() / 255)

    def test_arrays_that_are_no_weights(self, scene):
        (scene / "mine").mkdir()
        for values, message in (
            (np.full((8, 12), -1.0), "negative values"),
            (np.full((8, 12), np.nan), "not finite"),
            (np.ones((8, 12), object), "Object arrays cannot be loaded"),
            (np.ones((12, 8)), "ratio of sides"),
            (np.ones(96), "not floats of"),
            (np.full((8, 12), 1e9), r"a weight of 1e\+09"),
        ):
            np.save(scene / "mine/a.npy", values, allow_pickle=True)
            self.refuse(scene, rf"a\.npy: .*{message}", weights="mine")
        np.save(scene / "mine/a.npy", np.ones((8, 12)))
        (scene / "mine/a.npy").write_bytes((scene / "mine/a.npy").read_bytes()[:-8])
        self.refuse(scene, r"a\.npy: not an array that can be read", weights="mine")
        (scene / "mine/a.npy").write_bytes(b"\x93NUMPY\x01\x00\x10\x00{'descr': open(")
        self.refuse(scene, r"a\.npy: not an array that can be read", weights="mine")
        self.refuse(scene, "weight_scale must be above 0", scale=float("nan"))

    def test_a_store_with_masks_asks_for_them_again(self, scene):
        precompute(read_scene(scene), maps=UserMaps("masks"))
        before = sorted(path.name for path in (scene / "legs_weights").iterdir())
        with pytest.raises(LegsError, match="has maps of --masks: give it again"):
            precompute(read_scene(scene), resolution=2)
        assert sorted(path.name for path in (scene / "legs_weights").iterdir()) == before


class TestAgain:
    def test_masks_are_of_every_size_in_the_store_and_replace_older_ones(self, scene):
        precompute(read_scene(scene), resolution=2)
        precompute(read_scene(scene), maps=UserMaps("masks"))
        assert len(WeightStore(scene / "legs_weights").of_kind(MASK)) == 2
        Image.fromarray(255 - third()).save(scene / "masks/a.png")
        np.testing.assert_array_equal(mask_of(scene), 1 - third() / 255)
        store = WeightStore(scene / "legs_weights")
        half = next(entry for entry in store.of_kind(MASK) if entry.width == 6)
        np.testing.assert_array_equal(store.user_map(half)[0], [1, 1, 0, 0, 0, 0])
        files = len(list((scene / "legs_weights").glob("*.npy")))
        assert files == len(WeightStore(scene / "legs_weights").entries) == 8

    def test_one_photograph_with_two_masks_is_refused_when_it_is_used(self, scene):
        (scene / "images/b.png").write_bytes((scene / "images/a.png").read_bytes())
        with pytest.raises(LegsError, match=r"images/a\.png, images/b\.png are the same photograph, with different"):
            mask_of(scene)

    def test_the_command(self, scene):
        command = ("precompute", scene, "--workers", 1, "--masks", "masks")
        done = legs(*command)
        assert done.returncode == 0
        assert f"{scene}/legs_weights: 1 masks of your own" in done.stdout
        assert "counted whole, without a mask: images/b.png, images/c.png" in done.stderr
        (scene / "masks/a.png").write_bytes(b"")
        done = legs(*command)
        assert done.returncode == 2 and done.stderr.count("legs: error:") == 1 and "Traceback" not in done.stderr
