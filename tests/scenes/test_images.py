"""Photographs arrive with the size and the pixels that 3DGS's loader gives them."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from PIL import Image

from legs_loss.errors import LegsError
from legs_loss.scenes import View, image_tensor, load_training_image, training_size
from legs_loss.scenes.images import row_strips
from tests.support import photograph, save


def upstream_size(width, height, resolution):
    """Compute the size that 3DGS's loader gives, in its order of operations (resolution_scale is 1.0)."""
    if resolution in [1, 2, 4, 8]:
        return round(width / (1.0 * resolution)), round(height / (1.0 * resolution))
    if resolution == -1:
        shrink = width / 1600 if width > 1600 else 1
    else:
        shrink = width / resolution
    scale = float(shrink) * 1.0
    return int(width / scale), int(height / scale)


def upstream_tensor(image, size):
    """Turn an opened image into 3DGS's tensor: [C, H, W] in [0, 1], the colour channels of it."""
    pixels = torch.from_numpy(np.array(image.resize(size))) / 255.0
    return (pixels if pixels.dim() == 3 else pixels[..., None]).permute(2, 0, 1)[:3]


def load(path, *args, **kwargs):
    return load_training_image(View(path.name, path), *args, **kwargs)


class TestTrainingSize:
    @settings(max_examples=500)
    @given(st.integers(1, 20000), st.integers(1, 20000), st.sampled_from([-1, 1, 2, 4, 8]) | st.integers(1, 5000))
    def test_is_upstreams(self, width, height, resolution):
        expected = upstream_size(width, height, resolution)
        assume(min(expected) > 0)
        assert training_size(width, height, resolution) == expected

    @pytest.mark.parametrize(
        ("size", "resolution", "expected"),
        [
            ((1600, 1201), -1, (1600, 1201)),
            ((1601, 1201), -1, (1599, 1200)),  # 1601 / (1601 / 1600) falls just short of 1600
            ((4946, 3286), -1, (1600, 1063)),
            ((1237, 822), 4, (309, 206)),  # 309.25 and 205.5: halves round to even
            ((1237, 822), 8, (155, 103)),
            ((1001, 701), 2, (500, 350)),
            ((354, 631), 180, (180, 320)),
            ((100, 50), 200, (200, 100)),
        ],
    )
    def test_by_hand(self, size, resolution, expected):
        assert training_size(*size, resolution) == expected

    @pytest.mark.parametrize("resolution", [0, -2, -1600])
    def test_nonsense_is_refused(self, resolution):
        with pytest.raises(LegsError, match=str(resolution)):
            training_size(100, 100, resolution)

    def test_no_pixel_left_is_refused(self):
        with pytest.raises(LegsError, match="2000x1"):
            training_size(2000, 1, -1)


class TestPixels:
    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff", ".bmp"])
    @pytest.mark.parametrize("resolution", [-1, 1, 2, 100])
    def test_colour_is_upstreams(self, tmp_path, suffix, resolution):
        path = save(tmp_path / f"a{suffix}", photograph(181, 67))
        image = load(path, resolution)
        expected = upstream_tensor(Image.open(str(path)), training_size(181, 67, resolution))
        assert image.dtype == np.uint8
        assert torch.equal(image_tensor(image), expected)

    def test_the_real_capture_is_upstreams(self, fox):
        path = fox / "images" / "0001.jpg"
        for resolution in (-1, 2, 180):
            expected = upstream_tensor(Image.open(str(path)), training_size(354, 631, resolution))
            assert torch.equal(image_tensor(load(path, resolution)), expected)

    def test_wider_than_1600_is_upstreams(self, tmp_path):
        path = save(tmp_path / "a.jpg", photograph(1801, 120))
        expected = upstream_tensor(Image.open(str(path)), upstream_size(1801, 120, -1))
        assert torch.equal(image_tensor(load(path)), expected)

    def test_gray_stays_one_channel(self, tmp_path):
        path = save(tmp_path / "a.png", photograph(40, 30, channels=1))
        image = load(path, 2)
        assert image.shape == (15, 20, 1)
        assert torch.equal(image_tensor(image), upstream_tensor(Image.open(str(path)), (20, 15)))

    def test_alpha_is_resized_along_and_dropped(self, tmp_path):
        # Pillow weights colour by alpha while it resizes, so RGB alone would give other pixels.
        path = save(tmp_path / "a.png", photograph(40, 30, channels=4))
        image = load(path, 2)
        assert torch.equal(image_tensor(image), upstream_tensor(Image.open(str(path)), (20, 15)))
        assert not np.array_equal(image, np.array(Image.open(str(path)).convert("RGB").resize((20, 15))))

    def test_exif_orientation_is_not_applied(self, tmp_path):
        exif = Image.Exif()
        exif[0x0112] = 6  # a quarter turn
        path = save(tmp_path / "a.jpg", photograph(40, 30), exif=exif)
        image = load(path)
        assert image.shape == (30, 40, 3)
        assert np.array_equal(image, np.array(Image.open(str(path))))

    def test_palette_becomes_what_it_shows(self, tmp_path):
        palette = Image.new("P", (2, 1))
        palette.putpalette([10, 20, 30, 200, 100, 50])
        palette.putpixel((1, 0), 1)
        palette.save(str(tmp_path / "a.png"))
        palette.save(str(tmp_path / "b.png"), transparency=0)
        for name in ("a.png", "b.png"):
            assert load(tmp_path / name).tolist() == [[[10, 20, 30], [200, 100, 50]]]

    @pytest.mark.parametrize(("mode", "suffix", "channels"), [("CMYK", "jpg", 3), ("1", "png", 1), ("LA", "png", 3)])
    def test_other_modes(self, tmp_path, mode, suffix, channels):
        image = Image.fromarray(photograph(16, 16)).convert(mode)
        image.save(str(tmp_path / f"a.{suffix}"))
        expected = np.array(image.convert("RGB" if channels == 3 else "L")).reshape(16, 16, channels)
        assert np.abs(load(tmp_path / f"a.{suffix}").astype(int) - expected).max() <= (90 if suffix == "jpg" else 0)

    @pytest.mark.parametrize("suffix", ["png", "tiff"])
    def test_gray_of_16_bits_keeps_its_depth(self, tmp_path, suffix):
        deep = (np.arange(64 * 48).reshape(48, 64) * 21).astype(np.uint16)
        Image.fromarray(deep).save(str(tmp_path / f"a.{suffix}"))
        image = load(tmp_path / f"a.{suffix}")
        assert image.dtype == np.uint16
        assert np.array_equal(image[:, :, 0], deep)
        assert float(image_tensor(image).max()) == pytest.approx(deep.max() / 65535)

    def test_gray_of_16_bits_resizes_like_its_8_bits(self, tmp_path):
        shallow = photograph(64, 48, channels=1)
        Image.fromarray(shallow[..., 0].astype(np.uint16) * 257).save(str(tmp_path / "deep.png"))
        save(tmp_path / "shallow.png", shallow)
        difference = image_tensor(load(tmp_path / "deep.png", 2)) - image_tensor(load(tmp_path / "shallow.png", 2))
        assert difference.abs().max() < 1.5 / 255

    def test_colour_of_16_bits_is_read_as_8(self, tmp_path):
        values = (np.arange(6 * 4 * 3).reshape(4, 6, 3) * 900).astype(">u2")
        rows = b"".join(b"\0" + row.tobytes() for row in values)
        header = struct.pack(">IIBBBBB", 6, 4, 16, 2, 0, 0, 0)
        chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
        data = b"\x89PNG\r\n\x1a\n"
        for name, body in chunks:
            data += struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        (tmp_path / "a.png").write_bytes(data)
        assert np.array_equal(load(tmp_path / "a.png"), (values // 256).astype(np.uint8))


class TestBackground:
    def load(self, path, *args, **kwargs):
        return load_training_image(View(path.name, path, composited=True), *args, **kwargs)

    def test_by_hand(self, tmp_path):
        path = save(tmp_path / "a.png", np.array([[[200, 0, 100, 128]]], np.uint8))
        # 200 * 128 / 255 = 100.39; over white 127 more. Fractions are cut off.
        assert self.load(path).tolist() == [[[100, 0, 50]]]
        assert self.load(path, white_background=True).tolist() == [[[227, 127, 177]]]

    @pytest.mark.parametrize("white", [False, True])
    def test_at_full_size_in_float64_then_resized(self, tmp_path, white):
        pixels = photograph(300, 700, channels=4)  # more than one strip
        path = save(tmp_path / "a.png", pixels)
        unit = pixels / 255.0
        whole = unit[..., :3] * unit[..., 3:4] + np.array([float(white)] * 3) * (1 - unit[..., 3:4])
        flat = Image.fromarray((whole * 255.0).astype(np.uint8))
        assert len(list(row_strips(700, 300))) > 1
        assert np.array_equal(self.load(path, 2, white), np.array(flat.resize((150, 350))))

    def test_an_opaque_image_is_itself(self, tmp_path):
        pixels = photograph(40, 30)
        assert np.array_equal(self.load(save(tmp_path / "a.png", pixels), white_background=True), pixels)


class TestBroken:
    def error(self, path):
        with pytest.raises(LegsError) as raised:
            load(path)
        assert str(path) in str(raised.value)
        return str(raised.value)

    @pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tiff"])
    def test_cut_short(self, tmp_path, suffix):
        path = save(tmp_path / f"a{suffix}", photograph(64, 64))
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert "not an image that Pillow can read" in self.error(path)

    def test_no_image_at_all(self, tmp_path):
        for name, data in (("empty.png", b""), ("text.jpg", b"hello"), ("folder.png", None)):
            path = tmp_path / name
            path.mkdir() if data is None else path.write_bytes(data)
            self.error(path)
        assert "no such file" in self.error(tmp_path / "absent.png")

    def test_floats_and_32_bits(self, tmp_path):
        Image.fromarray(np.zeros((4, 4), np.float32)).save(str(tmp_path / "float.tiff"))
        assert "floats" in self.error(tmp_path / "float.tiff")
        Image.fromarray(np.full((4, 4), 70000, np.int32)).save(str(tmp_path / "deep.tiff"))
        assert "more than 16 bits" in self.error(tmp_path / "deep.tiff")


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_strips_cover_every_row_once(height, width):
    rows = [row for strip in row_strips(height, width) for row in range(strip.start, strip.stop)]
    assert rows == list(range(height))
