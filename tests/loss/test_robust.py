"""Weights normalised over the scene, the preset "legs-robust": the effects of blur, noise and a dead pixel."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage
from torch.nn.functional import conv2d, pad

from legs_loss import LegsError, LEGSLoss, WeightSpec, configure, l1_loss, legs_loss, weight_map
from legs_loss.cli import main
from legs_loss.kernels.available import BACKENDS
from legs_loss.lab.training.dataset import weight_maps
from legs_loss.precompute import precompute
from legs_loss.precompute.photograph import levels_of
from legs_loss.responses import gaussian_blur, response, response_levels
from legs_loss.runtime import state
from legs_loss.scenes import image_tensor, load_training_image, read_scene
from legs_loss.spec import PRESETS
from legs_loss.store import MANIFEST, WeightStore
from legs_loss.store.manifest import read_manifest
from legs_loss.weights import weight_from_response
from tests.support import start_run

ROBUST = PRESETS["legs-robust"]
SIZE = (48, 64)


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder."""
    start_run(monkeypatch, tmp_path)
    yield
    state.reset()


def photographs(seed: int, shapes: int, texture: float, count: int = 5):
    """Drawn views of one scene, float32 [3, H, W]: shaded boxes and discs before a ramp, some texture, 8 bits."""
    random = np.random.default_rng(seed)
    height, width = SIZE
    y, x = np.mgrid[:height, :width]
    ramp = (0.3 + 0.4 * x / width)[..., None] * random.uniform(0.6, 1.0, 3)
    kinds = [(random.random() < 0.5, random.uniform(3, 12), random.random(3)) for _ in range(shapes)]
    views = []
    for _ in range(count):
        image = ramp.copy()
        for is_disc, size, colour in kinds:
            top, left = random.uniform(0, height), random.uniform(0, width)
            inside = (
                np.hypot(y - top, x - left) < size
                if is_disc
                else (np.abs(y - top) < size) & (np.abs(x - left) < size / 2)
            )
            image[inside] = colour
        image = image + texture / 255 * ndimage.gaussian_filter(random.standard_normal((height, width, 1)), (1, 1, 0))
        pixels = (image.clip(0, 1) * 255).round() / 255
        views.append(torch.from_numpy(pixels).permute(2, 0, 1).float().contiguous())
    return views


def moved(image, length=9):
    kernel = torch.full((3, 1, 1, length), 1.0 / length)
    return conv2d(pad(image[None], (length // 2, length // 2, 0, 0), mode="reflect"), kernel, groups=3)[0]


def noisy(image, sigma, gray=False):
    noise = torch.randn(1 if gray else 3, *image.shape[1:], generator=torch.Generator().manual_seed(3))
    return ((image + sigma / 255 * noise).clamp(0, 1) * 255).round() / 255


DEGRADED = {
    "blur 2": lambda image: gaussian_blur(image, 2.0),
    "blur 4": lambda image: gaussian_blur(image, 4.0),
    "motion": moved,
    "noise 5": lambda image: noisy(image, 5),
    "noise 10": lambda image: noisy(image, 10),
    "gray noise 10": lambda image: noisy(image, 10, gray=True),
}


def mean_weights(views, spec=ROBUST):
    return [float(weight.mean()) for weight in weight_maps(views, spec)]


class TestValues:
    def test_as_numpy_and_scipy_compute_it(self):
        views = [view.double() for view in photographs(1, 6, 8.0)]
        strengths = []
        for view in views:
            smooth = [ndimage.gaussian_filter(band, 0.7, mode="mirror") for band in view.numpy()]
            strengths.append(np.sqrt(sum(ndimage.laplace(band, mode="mirror") ** 2 for band in smooth)))
        count = strengths[0].size
        median = np.median([np.sort(one.ravel())[(count + 1) // 2 - 1] for one in strengths])
        strong = np.median([np.sort(one.ravel())[int(np.ceil(0.99 * count)) - 1] for one in strengths])
        for strength, weight in zip(strengths, weight_maps(views, ROBUST)):
            floor = 3.0 * max(np.sort(strength.ravel())[(count + 1) // 2 - 1], median)
            normalised = np.clip((strength - floor) / (strong + 1e-8), 0, 1)
            np.testing.assert_allclose(weight[0].numpy(), 1 + 10 * np.sqrt(normalised), rtol=1e-6, atol=1e-6)

    def test_one_image_is_its_own_scene_and_a_batch_is_one(self):
        views = photographs(2, 6, 8.0)
        torch.testing.assert_close(weight_map(views[0], ROBUST), weight_maps(views[:1], ROBUST)[0])
        batch = weight_map(torch.stack(views), ROBUST)
        torch.testing.assert_close(batch, torch.stack(weight_maps(views, ROBUST)))
        last = weight_map(torch.stack(views).movedim(1, -1), ROBUST)
        torch.testing.assert_close(last.movedim(-1, 1), batch)

    def test_a_constant_image_has_no_weight(self):
        wall = torch.full((3, 20, 30), 1.0 / 3.0)
        assert torch.equal(weight_map(wall, ROBUST), torch.ones(1, 20, 30))

    def test_a_nan_is_not_hidden(self):
        strength = torch.rand(1, 8, 8)
        strength[0, 2, 2] = torch.nan
        assert response_levels(strength, ROBUST).isnan().all()


class TestBlurAndNoise:
    @given(
        st.integers(0, 10_000), st.integers(3, 12), st.sampled_from([0.0, 4.0, 12.0]), st.sampled_from(sorted(DEGRADED))
    )
    @example(0, 8, 4.0, "blur 2")
    @settings(max_examples=120)
    def test_never_raise_the_mean_weight_of_a_view(self, seed, shapes, texture, how):
        views = photographs(seed, shapes, texture)
        before = mean_weights(views)[2]
        views[2] = DEGRADED[how](views[2])
        assert mean_weights(views)[2] <= before + 0.02

    @pytest.mark.parametrize("how", ["blur 2", "noise 10"])
    def test_raise_that_of_legs(self, how):  # so the test above can fail
        views = photographs(0, 8, 4.0)
        before = mean_weights(views, PRESETS["legs"])[2]
        views[2] = DEGRADED[how](views[2])
        assert mean_weights(views, PRESETS["legs"])[2] > before + 0.3

    @pytest.mark.parametrize("gray", [False, True])
    def test_of_a_wall_are_not_weighted(self, gray):
        wall = noisy(torch.full((3, *SIZE), 0.5), 1, gray)
        assert float(weight_map(wall, "legs").mean()) > 4.0
        assert float(weight_maps([*photographs(0, 8, 4.0), wall], ROBUST)[-1].mean()) < 1.005

    def test_of_a_wall_alone_are_hardly_weighted(self):
        assert float(weight_map(noisy(torch.full((3, *SIZE), 0.5), 1), ROBUST).mean()) < 1.02

    @given(st.integers(0, 10_000), st.integers(8, 39), st.integers(8, 55))
    @settings(max_examples=40)
    def test_a_dead_pixel_changes_nothing_else(self, seed, y, x):
        views = photographs(seed, 8, 8.0)
        before = weight_maps(views, ROBUST)
        views[2] = views[2].clone()
        views[2][:, y, x] = 1.0 - views[2][:, y, x].round()
        after = weight_maps(views, ROBUST)
        after[2][:, y - 4 : y + 5, x - 4 : x + 5] = before[2][:, y - 4 : y + 5, x - 4 : x + 5]
        # Of 11; ranks of this small picture move by its neighbourhood's 81 pixels of 3072.
        assert max(float((a - b).abs().mean()) for a, b in zip(after, before)) < 0.1

    def test_the_real_capture(self, fox):
        views = [image_tensor(load_training_image(view, 4)) for view in read_scene(fox).views[::4]]
        before = mean_weights(views)[5]
        assert before > 1.4  # there is something to lose
        for how, degrade in DEGRADED.items():
            worse = [*views[:5], degrade(views[5]), *views[6:]]
            assert mean_weights(worse)[5] <= before, how


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    root = tmp_path_factory.mktemp("scene")
    (root / "images").mkdir()
    for index, view in enumerate(photographs(4, 8, 8.0)):
        pixels = (view.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
        Image.fromarray(pixels).save(root / "images" / f"{index}.png")
    return root


class TestStore:
    def test_what_is_stored_gives_the_weights_of_the_scene(self, scene, tmp_path):
        read = read_scene(scene)
        precompute(read, tmp_path / "maps", "legs-robust")
        store = WeightStore(tmp_path / "maps")
        images = [image_tensor(load_training_image(view)) for view in read.views]
        levels = store.scene_levels(ROBUST, SIZE[0] * SIZE[1])
        torch.testing.assert_close(levels, levels_of(images, ROBUST), rtol=1e-5, atol=1e-7)
        entry = store.find("0", *SIZE, ROBUST)
        strength = response(images[0], smooth=ROBUST.smooth)[0]
        np.testing.assert_allclose(store.response(entry), strength, atol=float(strength.max()) / 4096 + 1e-6)

    def test_the_manifest_says_so_and_one_without_is_as_before(self, scene, tmp_path):
        precompute(read_scene(scene), tmp_path, "legs")
        plain = json.loads((tmp_path / MANIFEST).read_text())
        assert plain["version"] == 3
        assert set(plain["entries"][0]).isdisjoint({"smooth", "low", "span", "percentile", "median", "strong"})
        precompute(read_scene(scene), tmp_path, "legs-robust")
        both = json.loads((tmp_path / MANIFEST).read_text())
        assert both["version"] == 3
        assert len(both["entries"]) == 10
        assert {entry.percentile for entry in read_manifest(tmp_path)} == {None, 99.0}
        again = precompute(read_scene(scene), tmp_path, "legs-robust")
        assert len(again.kept) == 5

    def test_a_map_of_another_preset_is_not_taken_for_it(self, scene, tmp_path):
        precompute(read_scene(scene), tmp_path, "legs")
        store = WeightStore(tmp_path)
        assert store.find("0", *SIZE, PRESETS["legs"]) is not None
        assert store.find("0", *SIZE, ROBUST) is None
        assert store.scene_levels(ROBUST, SIZE[0] * SIZE[1]) is None
        with pytest.raises(LegsError, match="weight_over_scene"):
            weight_from_response(torch.rand(1, 4, 4), ROBUST)

    def test_the_commands_take_the_preset(self, scene, tmp_path, capsys):
        assert (
            main(["precompute", str(scene), "--preset", "legs-robust", "--out", str(tmp_path), "--workers", "1"]) == 0
        )
        pytest.importorskip("matplotlib")
        sheet = tmp_path / "sheet.png"
        for what in (scene, tmp_path, scene / "images" / "0.png"):
            assert main(["show", str(what), "--preset", "legs-robust", "--out", str(sheet)]) == 0
            assert Image.open(sheet).width > 100
            sheet.unlink()
        capsys.readouterr()
        assert main(["show", str(tmp_path), "--preset", "legs", "--out", str(sheet)]) == 2
        assert "no maps for this preset" in capsys.readouterr().err


class TestTraining:
    @pytest.mark.parametrize(
        "train",
        [l1_loss, LEGSLoss(ROBUST), partial(legs_loss, spec="legs-robust")],
        ids=["l1_loss", "LEGSLoss", "legs_loss"],
    )
    def test_without_the_levels_of_the_scene_it_stops(self, train):
        configure("legs-robust")
        view = photographs(5, 8, 8.0)[0]
        with pytest.raises(LegsError, match=r"legs precompute SCENE --preset legs-robust"):
            train(view.clone().requires_grad_(), view)
        assert train(view, view) == 0 if train is l1_loss else True  # evaluation needs no weight

    def test_a_store_of_another_preset_or_size_has_not_its_levels(self, scene, tmp_path):
        precompute(read_scene(scene), tmp_path, "legs")
        configure("legs-robust", store=tmp_path)
        small = photographs(4, 8, 8.0)[0]
        with pytest.raises(LegsError, match=rf"{tmp_path.name} does not have for 3072 pixels: run legs precompute"):
            l1_loss(small.clone().requires_grad_(), small)
        precompute(read_scene(scene), tmp_path, "legs-robust")
        configure("legs-robust", store=tmp_path)
        assert l1_loss(torch.zeros(3, *SIZE, requires_grad=True), small) > small.mean()
        with pytest.raises(LegsError, match="does not have for 1024 pixels"):
            l1_loss(torch.zeros(3, 32, 32, requires_grad=True), torch.rand(3, 32, 32))

    def test_with_a_store_all_views_are_from_the_first_step(self, tmp_path):
        (tmp_path / "images").mkdir()
        views = photographs(6, 8, 8.0)
        for index, view in enumerate(views):
            pixels = (view.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
            Image.fromarray(pixels).save(tmp_path / "images" / f"{index}.png")
        precompute(read_scene(tmp_path), spec="legs-robust")
        configure("legs-robust", store=tmp_path / "legs_weights")
        prediction = torch.rand(views[0].shape, requires_grad=True)
        expected = (weight_maps(views, ROBUST)[0] * (prediction - views[0]).abs()).mean()
        torch.testing.assert_close(l1_loss(prediction, views[0], view="0"), expected, rtol=1e-3, atol=1e-5)
        shifted = views[0].roll(1, 1)  # an image that the store has not: weighed by the store's levels
        expected = (weight_map(shifted, ROBUST, scene=levels_of(views, ROBUST)) * (prediction - shifted).abs()).mean()
        torch.testing.assert_close(l1_loss(prediction, shifted, view="0"), expected, rtol=1e-5, atol=1e-6)
        two = [torch.stack(views[:2]), torch.stack(weight_maps(views, ROBUST)[:2])]
        prediction = torch.rand(two[0].shape, requires_grad=True)
        expected = (two[1] * (prediction - two[0]).abs()).mean()
        torch.testing.assert_close(l1_loss(prediction, two[0]), expected, rtol=1e-3, atol=1e-5)
        module = LEGSLoss("legs-robust", store=tmp_path / "legs_weights")
        expected = legs_loss(prediction[0], views[0], weight=weight_maps(views, ROBUST)[0])
        torch.testing.assert_close(module(prediction[0], views[0]), expected, rtol=1e-3, atol=1e-5)

    def test_the_trainers_views(self, tiny_scene, tmp_path):
        pytest.importorskip("numba")
        from legs_loss.lab.training.dataset import load_dataset

        scene = read_scene(tiny_scene)
        computed = load_dataset(scene, ROBUST)
        for view, weight in zip(computed.train, weight_maps([view.image for view in computed.train], ROBUST)):
            torch.testing.assert_close(view.weight, weight)
        precompute(scene, tmp_path, "legs-robust")
        stored = load_dataset(scene, ROBUST, store=tmp_path)
        levels = WeightStore(tmp_path).scene_levels(ROBUST, 64 * 48)  # of the held-out views too
        for view in stored.train:
            expected = weight_map(view.image, ROBUST, scene=levels)
            assert float((view.weight - expected).abs().mean()) < 0.01

    def test_no_backend_takes_it_for_another(self):
        for name, changes in (("over", {"over": "scene"}), ("smooth", {"smooth": 0.7})):
            spec = WeightSpec(**changes)
            backend = BACKENDS.availability(torch.device("cpu")).backend
            assert backend is None or not backend.makes_weights_of(spec), name

    def test_a_compiled_graph_declines(self, monkeypatch):
        configure("legs-robust")
        monkeypatch.setattr("legs_loss.runtime.l1.is_compiling", lambda: True)
        with pytest.raises(LegsError, match=r"torch\.compile"):
            l1_loss(torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8))

    def test_a_target_that_is_no_image_is_refused(self, scene, tmp_path):
        precompute(read_scene(scene), tmp_path, "legs-robust")
        configure("legs-robust", store=tmp_path)
        target = torch.rand(3, *SIZE)
        target[0, 0, 0] = torch.nan
        with pytest.raises(LegsError, match="NaN"):
            l1_loss(torch.rand(3, *SIZE, requires_grad=True), target)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"over": "room"}, 'over must be "image" or "scene"'),
        ({"noise_floor": 3.0}, 'goes with over="scene"'),
        ({"smooth": -1.0}, "smooth must be"),
        ({"over": "scene", "noise_floor": -1.0}, "noise_floor must be"),
    ],
)
def test_settings_that_do_not_fit(changes, message):
    with pytest.raises(LegsError, match=message):
        WeightSpec(**changes)
