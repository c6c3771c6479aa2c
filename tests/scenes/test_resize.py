"""The compiled resampling gives Pillow's own pixels, and Pillow does the work wherever it does not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from legs_loss.kernels.backends import backend_for
from legs_loss.precompute import precompute
from legs_loss.scenes import load_training_image, read_scene
from legs_loss.store import WeightStore, fingerprint
from tests.support import save

pytest.importorskip("numba")
from legs_loss.kernels import numba_resize


def noise(width, height, seed=0):
    """Every value is there, so that the cubic overshoots at both ends."""
    return np.random.RandomState(seed).choice([0, 1, 77, 128, 254, 255], (height, width, 3)).astype(np.uint8)


def two_passes(image, size):
    """Pillow along the rows, then along the columns, which is the order for a photograph that keeps its shape."""
    return np.asarray(image.resize((size[0], image.height)).resize(size))


class TestResized:
    @settings(deadline=None, max_examples=60)
    @given(st.integers(8, 150), st.integers(1, 90), st.data())
    def test_it_is_pillow_s_to_the_last_bit(self, width, height, data):
        size = data.draw(st.integers(8, width)), data.draw(st.integers(1, height))
        image = Image.fromarray(noise(width, height))
        assert np.array_equal(numba_resize.resized(image, size), two_passes(image, size))

    @pytest.mark.parametrize("size", [(1600, 1200), (1008, 756), (252, 189)])
    def test_a_photograph_s_size(self, size):
        image = Image.fromarray(noise(2016, 1513))
        assert np.array_equal(numba_resize.resized(image, size), np.asarray(image.resize(size)))


class TestResizedAs:
    @pytest.fixture(autouse=True)
    def forget(self, monkeypatch):
        monkeypatch.setattr(numba_resize, "_same", {})

    def calls(self, pillow, image, size, times=3):
        asked = []
        for _ in range(times):
            result = numba_resize.resized_as(lambda *args: asked.append(args) or pillow(*args), image, size)
            assert np.array_equal(result, pillow(image, size))
        return len(asked)

    def test_pillow_is_asked_once_for_each_pair_of_sizes(self):
        image = Image.fromarray(noise(90, 60))
        assert self.calls(two_passes, image, (45, 30)) == 1
        assert self.calls(two_passes, image, (30, 20)) == 1
        assert self.calls(two_passes, image, (45, 30)) == 0

    def test_another_arithmetic_is_pillow_s_to_the_end(self):
        image = Image.fromarray(noise(90, 60))
        assert self.calls(lambda image, size: two_passes(image, size) // 2, image, (45, 30)) == 3

    def test_columns_first_is_another_arithmetic(self):
        image = Image.fromarray(noise(90, 60))

        def columns_first(image, size):
            return np.asarray(image.resize((image.width, size[1])).resize(size))

        assert self.calls(columns_first, image, (45, 30)) == 3

    def test_one_colour_proves_nothing(self):
        flat = Image.fromarray(np.full((60, 90, 3), 77, np.uint8))
        assert self.calls(two_passes, flat, (45, 30)) == 3
        assert self.calls(two_passes, Image.fromarray(noise(90, 60)), (45, 30)) == 1


def test_precompute_s_maps_are_of_the_images_that_the_training_makes(tmp_path, monkeypatch):
    made = []
    resized = numba_resize.resized
    monkeypatch.setattr(numba_resize, "_same", {})
    monkeypatch.setattr(numba_resize, "resized", lambda *args: made.append(args) or resized(*args))
    for seed in range(3):  # large enough to be worth compiling for
        save(tmp_path / "photographs" / f"{seed}.png", noise(1200, 900, seed))
    scene = read_scene(tmp_path / "photographs")
    precompute(scene, out=tmp_path / "store", resolution=2)
    entries = WeightStore(tmp_path / "store").entries.values()
    images = {view.name: load_training_image(view, 2) for view in scene.views}
    assert {entry.view: entry.fingerprint for entry in entries} == {name: fingerprint(i) for name, i in images.items()}
    assert len(made) == (3 if backend_for(torch.device("cpu")) == "numba" else 0)
