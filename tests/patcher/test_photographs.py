"""A picture and its image file: parts, grey copies and renderings of a photograph; several captures."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from legs_adapters.trace.photographs import SURE, Photographs, is_another, thumbnail, uncut
from PIL import Image

SIZE = 96, 128
GROUNDS = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.3, 0.9, 0.1)


@pytest.fixture(scope="module")
def photograph():
    """A picture [3, H, W] of noise at three scales, in steps of 1/255."""
    generator = torch.Generator().manual_seed(0)
    parts = [torch.rand(1, 3, *size, generator=generator) for size in ((6, 8), (24, 32), SIZE)]
    picture = sum(F.interpolate(part, size=SIZE, mode="bilinear")[0] * w for part, w in zip(parts, (0.5, 0.3, 0.2)))
    return (picture * 255).round() / 255


def save(picture, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((picture * 255).round().byte().permute(1, 2, 0).numpy()).save(path)


class TestUncut:
    @pytest.mark.parametrize("is_last", [False, True])
    def test_a_part_is_traced_to_the_whole(self, photograph, is_last):
        whole = photograph.permute(1, 2, 0).contiguous().permute(2, 0, 1) if is_last else photograph.clone()
        assert torch.equal(uncut(whole[:, 5:40, 9:50]), whole)
        assert torch.equal(uncut(whole.permute(1, 2, 0)[5:40, 9:50]), whole)

    def test_of_several_pictures_it_is_the_one_that_was_cut(self, photograph):
        batch = torch.stack([photograph, 1 - photograph])
        assert torch.equal(uncut(batch[1, :, 5:40, 9:50]), batch[1])
        both = torch.cat([photograph, 1 - photograph])  # six channels
        assert torch.equal(uncut(both[3:, 5:40, 9:50]), both[3:])

    def test_a_whole_picture_and_one_that_was_computed_have_none(self, photograph):
        assert uncut(photograph.clone()) is None
        assert uncut(torch.stack([photograph, photograph])[1]) is None
        assert uncut(photograph[:, 5:40, 9:50] * 1.0) is None
        assert uncut(photograph[:, ::2, ::2]) is None


class TestAnother:
    def test_parts_and_exposures_are_the_same(self, photograph):
        mask = torch.zeros(SIZE)
        mask[20:60, 30:70] = 1
        matrix = torch.tensor([[0.9, 0.1, 0.0], [0.05, 0.8, 0.1], [0.0, 0.1, 0.7]])
        for same in (
            photograph, photograph * mask, photograph * mask + 1 - mask, 0.8 * photograph + 0.05,
            (1.5 * photograph).clamp(0, 1), torch.einsum("ij,jhw->ihw", matrix, photograph),
        ):  # fmt: skip
            assert not is_another(same, photograph)

    def test_a_rendering_is_another(self, photograph):
        soft = F.avg_pool2d(F.pad(photograph[None], (1, 1, 1, 1), mode="replicate"), 3, 1)[0]
        assert is_another(0.5 * photograph + 0.5 * soft, photograph)
        assert is_another(((0.5 * photograph + 0.5 * soft) * 255).round() / 255, photograph)


def covers():
    """Return masks [H, W] that are 0 at a border, at random blocks and points, or outside of a disc."""
    generator = torch.Generator().manual_seed(1)
    rows, columns = torch.meshgrid(*(torch.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    blocks = F.interpolate((torch.rand(1, 1, 12, 12, generator=generator) < 0.6).float(), size=SIZE)
    return {
        "border": ((rows.abs() < 0.97) & (columns.abs() < 0.97)).float(),
        "blocks": blocks[0, 0],
        "points": (torch.rand(SIZE, generator=generator) < 0.98).float(),
        "disc": (rows**2 + columns**2 < 0.5).float(),
    }


class TestFiles:
    @pytest.mark.parametrize(
        ("cover", "ground"),
        [(cover, ground) for cover in covers() for ground in GROUNDS if (cover, ground) != ("border", GROUNDS[-1])],
    )  # (a border of a colour is not known: no cell is of it alone)
    def test_a_photograph_on_a_ground_is_its_files_and_another_one_is_not(self, photograph, tmp_path, cover, ground):
        save(photograph, tmp_path / "images/0.png")
        save(photograph.flip(2), tmp_path / "images/1.png")
        mask = covers()[cover]
        laid, other = (
            p * mask + torch.tensor(ground)[:, None, None] * (1 - mask) for p in (photograph, photograph.flip(1))
        )
        photographs = Photographs([str(tmp_path)])
        found = photographs.match(thumbnail(laid))
        assert found.path == "images/0.png" and found.correlation >= 0.99 and found.is_photograph
        assert photographs.match(thumbnail(other)).correlation < SURE

    def test_a_grey_copy_is_no_photograph_unless_the_file_is_grey(self, photograph, tmp_path):
        coloured = 0.9 * photograph[:1].expand(3, -1, -1) + 0.1 * photograph
        grey = coloured.mean(0, keepdim=True).expand(3, -1, -1)
        save(coloured, tmp_path / "a/images/0.png")
        save(grey, tmp_path / "b/images/0.png")
        for picture, folder, is_photograph in [(coloured, "a", True), (grey, "a", False), (grey, "b", True)]:
            match = Photographs([str(tmp_path / folder)]).match(thumbnail(picture))
            assert match.correlation >= SURE and match.is_photograph is is_photograph

    @pytest.mark.parametrize("is_nested", [False, True])
    def test_each_capture_by_its_own_model(self, photograph, tmp_path, is_nested):
        """One lists its photographs, in a folder of any name; one has no model; a folder of no known name is none."""
        pictures = [photograph, 1 - photograph, photograph.flip(1), photograph.flip(2)]
        for picture, name in zip(pictures, ["one/pictures/0.png", "one/images/0.png", "two/images/0.png", "est/0.png"]):
            save(picture, tmp_path / name)
        frame = {"file_path": "pictures/0.png", "transform_matrix": np.eye(4).tolist()}
        (tmp_path / "one/transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": [frame]}))
        folders = [tmp_path] if is_nested else [tmp_path / name for name in ("one", "two", "est")]
        found = Photographs([str(folder) for folder in folders])
        assert [found.match(thumbnail(each)).is_photograph for each in pictures] == [True, False, True, False]
