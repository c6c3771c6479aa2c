"""The drop-in l1_loss with a store: a stored map is used for its own image and no other; captures."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from PIL import Image

from legs_loss import configure, l1_loss
from legs_loss.kernels.available import is_capturing
from legs_loss.precompute import precompute
from legs_loss.runtime import counts, state
from legs_loss.scenes import read_scene
from legs_loss.store import WeightStore, fingerprint, reading, sampled_fingerprint
from tests.runtime.support import weighted


@pytest.fixture
def scene(tmp_path):
    """Three photographs in a folder, with their stored maps."""
    folder = tmp_path / "scene" / "images"
    folder.mkdir(parents=True)
    generator = np.random.default_rng(0)
    for name in ("a.png", "b.png", "c.png"):
        Image.fromarray(generator.integers(0, 256, (9, 8, 3), dtype=np.uint8)).save(folder / name)
    precompute(read_scene(folder.parent))
    return folder.parent


def photograph(scene, name):
    return torch.from_numpy(np.array(Image.open(scene / "images" / name))).float().div(255).movedim(-1, 0)


class TestStore:
    def test_a_stored_map_is_used_for_its_own_image(self, scene):
        configure("legs", store=scene / "legs_weights")
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        for _ in range(3):
            loss = l1_loss(prediction, target, view="a")
            torch.testing.assert_close(loss, weighted(prediction, target), rtol=1e-3, atol=0)
        assert (counts().stored, counts().computed, counts().remembered) == (1, 0, 2)

    def test_the_scene_after_minus_s_is_found_by_itself(self, scene, monkeypatch):
        monkeypatch.setattr(sys, "argv", ["train.py", "-s", str(scene)])
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "b.png"), view="images/b.png")
        assert counts().stored == 1

    def test_on_the_cpu_it_is_found_without_a_name_or_under_another(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        for name, view in (("a", None), ("b", "a"), ("c", "nowhere")):
            l1_loss(torch.rand(3, 9, 8, requires_grad=True), photograph(scene, name + ".png"), view=view)
        assert (counts().stored, counts().computed) == (3, 0)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1 and f"maps from {scene / 'legs_weights'}" in lines[0]

    def test_the_first_line_says_what_was_used(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8))
        assert "weights computed from the training images" in capsys.readouterr().err
        configure("legs", store=scene / "legs_weights")
        state.reset_counts()
        batch = torch.stack([photograph(scene, "a.png"), torch.rand(3, 9, 8)])
        l1_loss(torch.rand(2, 3, 9, 8, requires_grad=True), batch)
        assert "but for 1 image(s), whose weight is computed" in capsys.readouterr().err

    def test_it_is_not_used_for_another_image_under_its_name(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        prediction = torch.rand(3, 9, 8, requires_grad=True)
        for shift in (1, 2):
            target = torch.roll(photograph(scene, "a.png"), shift, dims=2)
            torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target))
        assert (counts().stored, counts().computed) == (0, 2)
        assert capsys.readouterr().err.count("has no map of the training image of view 'a' of 8x9") == 1

    def test_nor_for_another_size_or_finer_values_or_an_unknown_view(self, scene, capsys):
        configure("legs", store=scene / "legs_weights")
        target = photograph(scene, "a.png")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), target + 0.3 / 255)  # the same to 8 bits
        l1_loss(torch.rand(3, 8, 8, requires_grad=True), target[:, :8], view="a")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8), view="z")
        assert (counts().stored, counts().computed) == (0, 3)
        assert capsys.readouterr().err.count("has no map of the training image of 8x9") == 1

    def test_on_a_device_each_new_tensor_is_found_by_a_sample_of_its_values(self, scene, monkeypatch):
        configure("legs", store=scene / "legs_weights")
        image = photograph(scene, "a.png")
        monkeypatch.setattr(reading, "sampled_fingerprint", lambda target: sampled_fingerprint(image))
        prediction, kept = torch.rand(3, 9, 8, device="meta", requires_grad=True), image.to("meta")
        for target in (kept, kept, image.to("meta"), image.to("meta")):
            l1_loss(prediction, target)
        assert (counts().stored, counts().remembered, counts().computed) == (3, 1, 0)

    def test_a_store_without_the_targets_is_asked_twice_a_view(self, scene, monkeypatch):
        configure("legs", store=scene / "legs_weights")
        asked = []
        monkeypatch.setattr(reading, "fingerprint", lambda target: asked.append(target) or fingerprint(target))

        def step(target):
            l1_loss(torch.rand(3, 9, 8, requires_grad=True), target)

        for _ in range(5):
            step(torch.rand(3, 9, 8))
        step(photograph(scene, "a.png"))  # one is found, so the count begins anew
        for _ in range(9):
            step(torch.rand(3, 9, 8))
        assert (len(asked), counts().stored, counts().computed) == (5 + 1 + 6, 1, 14)
        step(photograph(scene, "b.png"))
        assert len(asked) == 12 and counts().stored == 1

    def test_nor_for_another_operator(self, scene):
        configure("eggs", store=scene / "legs_weights")
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target, "eggs"))
        assert counts().stored == 0

    def test_a_damaged_store_is_said_once_and_computed(self, scene, capsys):
        for path in (scene / "legs_weights").glob("*.npy"):
            path.write_bytes(path.read_bytes()[:-1] + b"\xff")
        configure("legs", store=scene / "legs_weights")
        prediction = torch.rand(3, 9, 8, requires_grad=True)
        for name in ("a", "b", "c"):
            target = photograph(scene, name + ".png")
            torch.testing.assert_close(l1_loss(prediction, target, view=name), weighted(prediction, target))
        assert capsys.readouterr().err.count("its checksum differs") == 1

    def test_a_missing_store_is_said_and_computed(self, tmp_path, capsys):
        configure("legs", store=tmp_path / "nowhere")
        l1_loss(torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8), view="a")
        assert counts().computed == 1
        assert "is not a store of weight maps" in capsys.readouterr().err


class TestSampledFingerprint:
    def test_it_is_stored_beside_the_whole_one(self, scene):
        entries = WeightStore(scene / "legs_weights").entries.values()
        for entry in entries:
            image = photograph(scene, entry.view[len("images/") :])
            assert (entry.fingerprint, entry.sample) == (fingerprint(image), sampled_fingerprint(image))
        assert len({entry.sample for entry in entries}) == 3

    def test_a_shift_another_size_or_a_changed_block_has_another(self):
        image = torch.randint(0, 256, (3, 120, 160), generator=torch.Generator().manual_seed(0)).float() / 255
        block = image.clone()
        block[:, 40:52, 60:76] = 0.5  # a hundredth of the image
        others = [image, image.roll(1, 2), image.roll(1, 1), block, image * 0.999, image[:, :119], image.flip(-1)]
        assert len({sampled_fingerprint(other) for other in others}) == len(others)
        eight_bit = (image * 255).round().byte().permute(1, 2, 0).numpy()
        assert sampled_fingerprint(eight_bit) == sampled_fingerprint(image) == sampled_fingerprint(image.half())


class TestCapture:
    """While a CUDA graph is captured nothing is remembered: replays have other pixels in the same memory."""

    def test_each_call_computes_its_own_weight(self, monkeypatch, scene):
        monkeypatch.setenv("LEGS_BACKEND", "torch")
        configure("legs", store=scene / "legs_weights")
        run = state.current_run()
        monkeypatch.setattr(state, "is_capturing", lambda device: True)
        prediction, target = torch.rand(3, 9, 8, requires_grad=True), photograph(scene, "a.png")
        for _ in range(2):
            torch.testing.assert_close(l1_loss(prediction, target, view="a"), weighted(prediction, target))
            target.copy_(torch.rand(3, 9, 8))  # as a replay would find it
        assert (counts().computed, counts().stored, counts().remembered) == (2, 0, 0)
        assert len(run.memo._entries) == 0

    def test_only_a_cuda_device_is_asked(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
        assert is_capturing(torch.device("cuda"))
        assert not is_capturing(torch.device("cpu"))
        monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
        assert not is_capturing(torch.device("cuda"))
