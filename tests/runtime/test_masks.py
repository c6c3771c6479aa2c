"""Masks and weights of a store in a training step: the mean over what counts, gradients of 0, no silence."""

from __future__ import annotations

import sys
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

import legs_loss
from legs_loss import LegsError, configure, l1_loss
from legs_loss.precompute import UserMaps, precompute
from legs_loss.runtime import active, counts, state
from legs_loss.scenes import read_scene
from legs_loss.similarity import ssim_map
from tests.preloaded import run
from tests.runtime.support import plain
from tests.support import legs_environment

HEIGHT, WIDTH = 9, 8
ALONE = "legs-patch --masks hides masked pixels from other terms"


@pytest.fixture
def scene(tmp_path):
    """Three photographs: a and b with a mask (b's is gray in part), c without; weights for a alone."""
    generator = np.random.default_rng(0)
    for folder in ("images", "masks", "weights"):
        (tmp_path / "scene" / folder).mkdir(parents=True)
    for name in "abc":
        pixels = generator.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "scene" / "images" / f"{name}.png")
    for name, mask in masks().items():
        Image.fromarray(mask).save(tmp_path / "scene" / "masks" / f"{name}.png")
    Image.fromarray(user_weights()).save(tmp_path / "scene" / "weights" / "a.png")
    return tmp_path / "scene"


def masks():
    first, second = (np.full((HEIGHT, WIDTH), 255, np.uint8) for _ in range(2))
    first[:4] = 0
    second[:, :3], second[:, 3:5] = 0, 51
    return {"a": first, "b": second}


def user_weights():
    return np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH) + 100


def stored(scene, preset="legs", **folders):
    precompute(read_scene(scene), spec=preset, maps=UserMaps(**folders))
    configure(preset, store=scene / "legs_weights")


def photograph(scene, name):
    pixels = np.array(Image.open(scene / "images" / f"{name}.png"))
    return torch.from_numpy(pixels).float().div(255).movedim(-1, 0)


def rendering():
    return torch.rand(3, HEIGHT, WIDTH, requires_grad=True)


def by_hand(prediction, target, mask, preset="legs"):
    """Return sum(M W D) / sum(M) in float64."""
    mask = torch.from_numpy(mask).double() / 255
    weight = legs_loss.weight_map(target.double(), preset)[0]
    difference = (prediction - target).double().abs().mean(0)
    return (mask * weight * difference).sum() / mask.sum()


class TestLoss:
    @pytest.mark.parametrize("backend", ["torch", "numba"])
    @pytest.mark.parametrize("preset", ["legs", "3dgs"])
    def test_it_is_the_mean_over_what_counts(self, scene, monkeypatch, backend, preset):
        monkeypatch.setenv("LEGS_BACKEND", backend)
        stored(scene, preset, masks="masks")
        for name, mask in masks().items():
            prediction, target = rendering(), photograph(scene, name)
            loss = l1_loss(prediction, target)
            expected = by_hand(prediction, target, mask, preset)
            assert loss.item() == pytest.approx(expected.item(), rel=2e-4)  # the store's responses are float16
            found = torch.autograd.grad(loss, prediction)[0]
            torch.testing.assert_close(found, torch.autograd.grad(expected, prediction)[0], rtol=2e-3, atol=1e-8)
            assert not found[:, torch.from_numpy(mask == 0)].any()
        assert (counts().masked, counts().unmasked, counts().hidden) == (2, 0, 0)

    def test_what_a_codebase_does_with_the_map_is_the_mean_over_what_counts_too(self, scene):
        stored(scene, masks="masks")
        prediction, target = rendering(), photograph(scene, "a")
        expected = l1_loss(prediction, target)
        torch.testing.assert_close(l1_loss(prediction, target, reduction="none").mean(), expected)
        torch.testing.assert_close(l1_loss(prediction, target, own=plain), expected)
        last = l1_loss(prediction.movedim(0, -1)[None], target.movedim(0, -1)[None])
        torch.testing.assert_close(last, expected)

    def test_a_batch_and_a_view_without_a_mask(self, scene, capsys):
        stored(scene, masks="masks")
        target = torch.stack([photograph(scene, name) for name in "abc"])
        prediction = torch.rand(3, 3, HEIGHT, WIDTH, requires_grad=True)
        mask = np.stack([*masks().values(), np.full((HEIGHT, WIDTH), 255, np.uint8)])
        weight = legs_loss.weight_map(target)[:, 0]
        share = torch.from_numpy(mask).float() / 255
        expected = (share * weight * (prediction - target).abs().mean(1)).sum() / share.sum()
        assert l1_loss(prediction, target).item() == pytest.approx(expected.item(), rel=5e-4)
        assert (counts().masked, counts().unmasked) == (2, 0)
        whole = l1_loss(prediction[2], target[2])
        torch.testing.assert_close(whole, (weight[2] * (prediction - target)[2].abs()).mean(), rtol=1e-3, atol=0)
        assert "NOT MASKED" not in capsys.readouterr().err

    def test_a_mask_of_the_call_is_a_factor_beside_it(self, scene):
        stored(scene, "3dgs", masks="masks")
        prediction, target = rendering(), photograph(scene, "a")
        own, share = torch.rand(HEIGHT, WIDTH), torch.from_numpy(masks()["a"]) / 255
        expected = (share * own * (prediction - target).abs().mean(0)).sum() / share.sum()
        torch.testing.assert_close(l1_loss(prediction, target, mask=own), expected)

    @pytest.mark.parametrize("preset", ["legs", "3dgs"])
    def test_own_weights_multiply_the_presets(self, scene, preset):
        stored(scene, preset, weights="weights", scale=2.0)
        prediction, target = rendering(), photograph(scene, "a")
        own = torch.from_numpy(user_weights()).float() / 255 * 2.0
        expected = (own * legs_loss.weight_map(target, preset) * (prediction - target).abs()).mean()
        assert l1_loss(prediction, target).item() == pytest.approx(expected.item(), rel=1e-3)
        other = photograph(scene, "b")
        expected = (legs_loss.weight_map(other, preset) * (prediction - other).abs()).mean()
        assert l1_loss(prediction, other).item() == pytest.approx(expected.item(), rel=1e-3)


class TestMasked:
    def test_no_loss_sees_what_is_left_out(self, scene):
        stored(scene, masks="masks")
        for name, mask in masks().items():
            prediction, target = rendering(), photograph(scene, name)
            image = legs_loss.masked(prediction, target)
            left_out = torch.from_numpy(mask == 0)
            assert torch.equal(image[:, left_out], target[:, left_out])
            assert torch.equal(image[:, ~left_out], prediction[:, ~left_out])
            loss = l1_loss(image, target)
            assert (counts().masked, counts().hidden) == (1, 1)  # a view that both get is not counted twice
            state.reset_counts()
            loss = loss + legs_loss.d_ssim(image, target) + (image - target).square().mean()
            loss.backward()
            assert not prediction.grad[:, left_out].any()
            assert prediction.grad[:, ~left_out].all()
            torch.testing.assert_close(l1_loss(image, target), l1_loss(prediction, target))
            state.reset_counts()

    def test_it_keeps_the_predictions_shape(self, scene):
        stored(scene, masks="masks")
        prediction, target = rendering(), photograph(scene, "a")
        expected = legs_loss.masked(prediction, target)
        assert torch.equal(legs_loss.masked(prediction, target[None]), expected)
        assert torch.equal(legs_loss.masked(prediction[None], target[None])[0], expected)
        last = legs_loss.masked(prediction.movedim(0, -1), target.movedim(0, -1))
        assert torch.equal(last.movedim(-1, 0), expected)

    def test_it_is_the_very_tensor_where_nothing_is_left_out(self, scene, monkeypatch):
        prediction = rendering()
        configure("legs")
        assert legs_loss.masked(prediction, photograph(scene, "a")) is prediction
        stored(scene, masks="masks")
        assert legs_loss.masked(prediction, photograph(scene, "c")) is prediction
        with torch.no_grad():
            assert legs_loss.masked(prediction, photograph(scene, "a")) is prediction
        monkeypatch.setenv("LEGS_OFF", "1")
        configure(store=scene / "legs_weights")
        assert legs_loss.masked(prediction, photograph(scene, "a")) is prediction
        assert torch.equal(l1_loss(prediction, photograph(scene, "a")), plain(prediction, photograph(scene, "a")))


class TestOtherTerms:
    def test_ssim_is_of_what_counts(self, scene):
        stored(scene, masks="masks")
        for name, mask in masks().items():
            prediction, target = rendering(), photograph(scene, name)
            left_out, counts_for = torch.from_numpy(mask == 0), (mask > 0).mean()
            seen = torch.where(left_out, target, prediction)
            expected = 1.0 - legs_loss.d_ssim(seen, target) / counts_for
            for pair in ((prediction, target), (target, prediction), (legs_loss.masked(prediction, target), target)):
                found = legs_loss.ssim(*pair)
                torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
                gradient = torch.autograd.grad(found, prediction)[0]
                assert not gradient[:, left_out].any() and gradient[:, ~left_out].all()
            torch.testing.assert_close(legs_loss.ssim(prediction, target, 11, False), expected, rtol=1e-5, atol=1e-6)
            share = legs_loss.coverage(prediction, target)
            assert float(share) == pytest.approx(counts_for)
            with torch.no_grad():  # an evaluation is of all pixels, as that of every other codebase
                assert legs_loss.coverage(prediction, target) == 1.0
                torch.testing.assert_close(1 - legs_loss.ssim(prediction, target), legs_loss.d_ssim(prediction, target))

    def test_without_a_mask_nothing_changes(self, scene, monkeypatch):
        stored(scene, masks="masks")
        prediction, target = rendering(), photograph(scene, "c")
        assert legs_loss.coverage(prediction, target) == 1.0
        plain_ssim = 1.0 - legs_loss.d_ssim(prediction, target)
        torch.testing.assert_close(legs_loss.ssim(prediction, target), plain_ssim)
        monkeypatch.setenv("LEGS_OFF", "1")
        configure("legs", store=scene / "legs_weights")
        target = photograph(scene, "a")
        assert legs_loss.coverage(prediction, target) == 1.0
        assert torch.equal(legs_loss.ssim(prediction, target), ssim_map(prediction, target).mean())

    def test_a_batch_one_value_an_image(self, scene):
        stored(scene, masks="masks")
        target = torch.stack([photograph(scene, name) for name in "abc"])
        prediction = torch.rand(3, 3, HEIGHT, WIDTH, requires_grad=True)
        each = legs_loss.ssim(prediction, target, size_average=False)
        torch.testing.assert_close(each, torch.stack([legs_loss.ssim(*pair) for pair in zip(prediction, target)]))


class TestNoSilence:
    @pytest.mark.parametrize(
        ("change", "reason"),
        [
            (lambda target: target.roll(1, 2), "augmented, shifted"),
            (lambda target: target * 0.9 + 0.1, "augmented, shifted"),
            (lambda target: target[:, :8], f"the store has {WIDTH}x{HEIGHT}"),
        ],
    )
    @pytest.mark.parametrize("call", [l1_loss, legs_loss.masked, legs_loss.ssim])
    def test_a_target_that_is_not_found_is_said_once_with_the_reason(self, scene, capsys, change, reason, call):
        stored(scene, masks="masks")
        target = change(photograph(scene, "a"))
        for _ in range(3):
            call(torch.rand(target.shape, requires_grad=True), target)
        said = capsys.readouterr().err
        assert said.count("NOT MASKED") == 1 and reason in said
        assert counts().unmasked == (3 if call is l1_loss else 0)

    def test_every_target_is_looked_up_however_many_are_not_found(self, scene):
        stored(scene, masks="masks")
        for _ in range(20):
            l1_loss(rendering(), torch.rand(3, HEIGHT, WIDTH))
        l1_loss(rendering(), photograph(scene, "a"))
        assert (counts().masked, counts().unmasked) == (1, 20)

    def test_require_raises(self, scene, monkeypatch):
        monkeypatch.setenv("LEGS_MASKS", "require")
        stored(scene, masks="masks")
        l1_loss(rendering(), photograph(scene, "a"))
        l1_loss(rendering(), photograph(scene, "c"))  # it is there, and has no mask: it counts whole
        for call in (l1_loss, legs_loss.masked, legs_loss.ssim, legs_loss.coverage):
            with pytest.raises(LegsError, match=r"NOT MASKED.*augmented"):
                call(rendering(), torch.rand(3, HEIGHT, WIDTH))

    def test_require_without_masks_raises(self, scene, monkeypatch, tmp_path):
        monkeypatch.setenv("LEGS_MASKS", "require")
        configure("legs")
        for _ in range(2):  # whoever catches it trains no step without masks
            with pytest.raises(LegsError, match="there is no store"):
                l1_loss(rendering(), photograph(scene, "a"))
        stored(scene)
        with pytest.raises(LegsError, match="has no masks: legs precompute"):
            l1_loss(rendering(), photograph(scene, "a"))
        configure("legs", store=tmp_path / "nowhere")
        with pytest.raises(LegsError, match="is not a store"):
            l1_loss(rendering(), photograph(scene, "a"))
        monkeypatch.setenv("LEGS_MASKS", "yes")
        with pytest.raises(LegsError, match="LEGS_MASKS must be require"):
            configure("legs")

    def test_a_damaged_mask_is_an_error(self, scene):
        stored(scene, masks="masks")
        for path in (scene / "legs_weights").glob("*.npy"):
            path.write_bytes(path.read_bytes()[:-1] + b"\xff")
        with pytest.raises(LegsError, match="checksum"):
            l1_loss(rendering(), photograph(scene, "a"))

    def test_a_compiled_graph_is_refused(self, scene):
        stored(scene, masks="masks")
        for refused in (partial(state.spec_to_compile, is_trained=True), state.refuse_masks):
            with pytest.raises(LegsError, match="compiled or captured graph"):
                refused(state.generation)

    def test_beta_zero_with_masks_is_active(self, scene):
        stored(scene, "3dgs", masks="masks")
        assert active()

    @pytest.mark.parametrize("hidden", [False, True])
    def test_the_end_says_what_was_masked(self, scene, hidden):
        stored(scene, masks="masks")
        code = (
            "import sys, numpy, torch, legs_loss; from PIL import Image\n"
            f"legs_loss.configure('legs', store={str(scene / 'legs_weights')!r})\n"
            "for name in 'abc':\n"
            f"    pixels = numpy.array(Image.open({str(scene / 'images')!r} + f'/{{name}}.png'))\n"
            "    target = torch.from_numpy(pixels).float().div(255).movedim(-1, 0)\n"
            "    for one in (target, target.flip(-1)):\n"
            "        image = torch.rand(one.shape, requires_grad=True)\n"
            f"        image = legs_loss.masked(image, one) if {hidden} else image\n"
            "        legs_loss.l1_loss(image, one)\n"
        )
        done = run([sys.executable, "-c", code], env=legs_environment(), check=True)
        lines = done.stderr.splitlines()
        whole = (
            "legs-loss: masks: 2 view(s) masked, 1 without a mask counted whole, "
            "3 training image(s) were NOT FOUND in the store, so NOT MASKED"
        )
        assert lines[-2] == whole + ("" if hidden else ", in the L1 alone: " + ALONE)
        assert sum("masks from" in line for line in lines) == 1


class TestLibraries:
    """gsplat's and nerfstudio's losses, as their hooks have them: no term sees a masked pixel."""

    def test_gsplat(self, scene, tmp_path, monkeypatch):
        stored(scene, masks="masks")
        package = tmp_path / "gsplat"
        package.mkdir()
        (package / "__init__.py").write_text("")
        (package / "losses.py").write_text(
            "def l1_loss(pred, target):\n    return (pred - target).abs()\n\n\n"
            "def ssim_loss(pred, target, padding='valid'):\n    return (pred - target).square().mean()\n"
        )
        monkeypatch.syspath_prepend(str(tmp_path))
        prediction, target = rendering(), photograph(scene, "a")
        with legs_loss.apply_to_gsplat():
            from gsplat import losses

            image, pixels = prediction.movedim(0, -1)[None], target.movedim(0, -1)[None]
            loss = losses.l1_loss(image, pixels).mean()
            loss = loss + losses.ssim_loss(image.permute(0, 3, 1, 2), pixels.permute(0, 3, 1, 2), padding="valid")
        sys.modules.pop("gsplat.losses"), sys.modules.pop("gsplat")
        left_out = torch.from_numpy(masks()["a"] == 0)
        squares = (prediction - target).square()[:, ~left_out].mean()  # of what counts
        expected = by_hand(prediction, target, masks()["a"]) + squares
        assert loss.item() == pytest.approx(expected.item(), rel=2e-4)
        loss.backward()
        assert not prediction.grad[:, left_out].any() and prediction.grad[:, ~left_out].all()
        assert (counts().masked, counts().hidden) == (1, 1)

    def test_nerfstudio(self, scene):
        from legs_adapters.upstreams.nerfstudio import weighted

        stored(scene, masks="masks")
        target = photograph(scene, "a").movedim(0, -1)

        class Model:
            class config:
                ssim_lambda = 0.2

            def get_gt_img(self, image):
                return image

            def composite_with_background(self, image, background):
                return image

            def get_loss_dict(self, outputs, batch, metrics_dict=None):
                difference = outputs["rgb"] - batch["image"]
                return {"main_loss": 0.8 * difference.abs().mean() + 0.2 * difference.square().mean()}

        prediction = torch.rand(HEIGHT, WIDTH, 3, requires_grad=True)
        outputs, batch = {"rgb": prediction, "background": None}, {"image": target}
        loss = weighted(Model(), Model().get_loss_dict, outputs, batch, None)["main_loss"]
        loss.backward()
        left_out = torch.from_numpy(masks()["a"] == 0)
        assert not prediction.grad[left_out].any() and prediction.grad[~left_out].all()
        seen = torch.where(left_out[..., None], target, prediction.detach())
        expected = 0.8 * by_hand(prediction.movedim(-1, 0), target.movedim(-1, 0), masks()["a"])
        expected = expected + 0.2 * (seen - target).square().mean() / (~left_out).float().mean()
        assert loss.item() == pytest.approx(expected.item(), rel=2e-4)


class TestModule:
    @pytest.mark.parametrize("preset", ["legs", "3dgs"])
    def test_legs_loss_with_a_store_masks_both_terms(self, scene, preset):
        precompute(read_scene(scene), spec=preset, maps=UserMaps(masks="masks"))
        criterion = legs_loss.LEGSLoss(preset, store=scene / "legs_weights")
        for name, mask in masks().items():
            prediction, target = rendering(), photograph(scene, name)
            loss = criterion(prediction, target)
            left_out = torch.from_numpy(mask == 0)
            seen = torch.where(left_out, target, prediction)
            structural = legs_loss.d_ssim(seen, target) / (mask > 0).mean()
            expected = 0.8 * by_hand(prediction, target, mask, preset) + 0.2 * structural
            assert loss.item() == pytest.approx(expected.item(), rel=5e-4)
            loss.backward()
            assert not prediction.grad[:, left_out].any() and prediction.grad[:, ~left_out].all()

    def test_without_masks_it_is_the_loss_without_a_store(self, scene, capsys):
        precompute(read_scene(scene))
        prediction, target = rendering(), photograph(scene, "a")
        found = legs_loss.LEGSLoss("legs", store=scene / "legs_weights")(prediction, target)
        torch.testing.assert_close(found, legs_loss.LEGSLoss("legs")(prediction, target), rtol=1e-3, atol=0)
        assert "maps from" in capsys.readouterr().err
