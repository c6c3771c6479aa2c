"""Weight maps: hand-worked values, range, monotony, options, bad targets."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from legs_loss import LegsError, WeightSpec, configure, d_ssim, l1_loss, legs_loss, weight_map
from legs_loss.response import gaussian_blur
from legs_loss.weights import error_weight_map, weight_from_response
from tests.strategies import images

CURVES = ("C1", "C2", "C3", "C4", "C5")


def test_hand_worked():
    image = torch.tensor([[[1.0, 2.0, 4.0], [3.0, 5.0, 7.0], [6.0, 8.0, 9.0]]]) / 10
    # Laplacians in tenths, by hand: |6| |7| |2| / |4| |0| |-6| / |2| |-7| |-2|... see test_response for the rule.
    #   (0,0): 3+3+2+2-4 = 6    (0,1): 5+5+1+4-8 = 7       (0,2): 7+7+2+2-16 = 2
    #   (1,0): 1+6+5+5-12 = 5   (1,1): 2+8+3+7-20 = 0      (1,2): 4+9+5+5-28 = -5
    #   (2,0): 3+3+8+8-24 = -2  (2,1): 5+5+6+9-32 = -7     (2,2): 7+7+8+8-36 = -6
    strength = torch.tensor([[6.0, 7.0, 2.0], [5.0, 0.0, 5.0], [2.0, 7.0, 6.0]]) / 7
    torch.testing.assert_close(weight_map(image, "legs-l", False)[0], 1 + 10 * strength)
    torch.testing.assert_close(weight_map(image, "legs", False)[0], 1 + 10 * strength.sqrt())


@settings(max_examples=60, deadline=None)
@given(images(), st.floats(0, 50), st.sampled_from(CURVES), st.sampled_from(["laplacian", "sobel"]))
def test_weights_lie_between_one_and_one_plus_beta(image, beta, curve, operator):
    for dtype in (torch.float32, torch.float64):
        weight = weight_map(image.to(dtype), WeightSpec(operator=operator, curve=curve, beta=beta), False)
        assert float(weight.min()) >= 1.0
        assert float(weight.max()) <= torch.tensor(1.0 + beta, dtype=dtype).item() * (1 + 1e-7)


@settings(max_examples=40, deadline=None)
@given(images(), st.floats(0, 20), st.floats(0, 20), st.sampled_from(CURVES))
def test_weights_grow_with_beta(image, first, second, curve):
    low, high = sorted((first, second))
    spec = WeightSpec(curve=curve)
    weights = [weight_map(image, replace(spec, beta=beta), False) for beta in (low, high)]
    assert bool((weights[0] <= weights[1]).all())


@settings(max_examples=30, deadline=None)
@given(images(), st.sampled_from(CURVES))
def test_flips_move_the_map_along(image, curve):
    spec = WeightSpec(curve=curve)
    close = dict(rtol=0, atol=1e-5)
    weight = weight_map(image, spec, False)
    torch.testing.assert_close(weight_map(image.flip(-1), spec, False), weight.flip(-1), **close)
    torch.testing.assert_close(weight_map(image.mT.contiguous(), spec, False), weight.mT, **close)


@pytest.mark.parametrize("shape", [(3, 1, 9), (3, 9, 1), (1, 1, 1), (3, 2, 2)])
def test_thin_images(shape):
    weight = weight_map(torch.rand(shape), channels_last=False)
    assert weight.shape == (1, shape[1], shape[2])
    assert bool(((weight >= 1) & (weight <= 11)).all())


@pytest.mark.parametrize("preset", ["3dgs", "eggs", "legs-l", "legs"])
def test_a_constant_image_weighs_one(preset):
    assert torch.equal(weight_map(torch.full((3, 5, 7), 0.3), preset), torch.ones(1, 5, 7))


def test_mean_one():
    image = torch.rand(2, 3, 12, 12)
    weight = weight_map(image, WeightSpec(normalise="mean"))
    torch.testing.assert_close(weight.mean((1, 2, 3)), torch.ones(2))
    plain = weight_map(image, WeightSpec())
    torch.testing.assert_close(weight, plain / plain.mean((1, 2, 3), keepdim=True))


@pytest.mark.parametrize("percentile", [50.0, 90.0, 99.0, 100.0])
def test_percentile_in_place_of_the_maximum(percentile):
    normalised = torch.rand(2, 1, 20, 20)
    weight = weight_from_response(normalised, WeightSpec(curve="C1", percentile=percentile, beta=1.0))
    for i in range(2):
        values = normalised[i].numpy()
        top = np.sort(values.ravel())[int(np.ceil(percentile / 100 * values.size)) - 1]
        top = 1.0 if percentile == 100.0 else top
        np.testing.assert_allclose(weight[i].numpy(), 1 + np.minimum(values / top, 1), rtol=1e-5)


def test_percentile_of_a_mostly_flat_image_is_finite():
    image = torch.zeros(1, 9, 9)
    image[0, 4, 4] = 1.0
    weight = weight_map(image, WeightSpec(percentile=50.0))
    assert bool(torch.isfinite(weight).all())
    assert (float(weight.min()), float(weight.max())) == (1.0, 11.0)


def test_layouts_and_types():
    image = torch.rand(2, 3, 6, 5)
    weight = weight_map(image)
    assert weight.shape == (2, 1, 6, 5)
    last = weight_map(image.movedim(1, -1))
    assert torch.equal(last, weight.movedim(1, -1))
    assert weight_map(image.half()).dtype == torch.float32
    assert weight_map(image.double()).dtype == torch.float64
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(weight_map(image), weight)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_broken_target_is_named(value):
    image = torch.rand(3, 4, 5)
    image[1, 2, 3] = value
    with pytest.raises(LegsError, match=r"\[3, 4, 5\] has 1 value"):
        weight_map(image)


def test_an_8_bit_range_is_named():
    with pytest.raises(LegsError, match="255"):
        weight_map(torch.rand(3, 4, 5) * 255)


def test_a_nan_that_is_not_looked_for_is_not_hidden():
    from legs_loss.response import normalise_response, response

    image = torch.rand(3, 6, 6)
    image[0, 0, 0] = float("nan")
    weight = weight_from_response(normalise_response(response(image)))
    assert bool(torch.isnan(weight).all())


def test_the_paper_prototypes_mean_weights_on_the_real_capture(fox):
    """The design's table: mean weight of each curve at beta 10, fox at 180 pixels of width."""
    from PIL import Image

    maps = {curve: [] for curve in CURVES}
    for path in sorted((fox / "images").glob("*.jpg"))[::5]:
        picture = Image.open(path)
        resized = picture.resize((180, int(picture.size[1] / (picture.size[0] / 180))))
        image = torch.from_numpy(np.array(resized)).float().div(255).movedim(-1, 0)
        for curve in CURVES:
            maps[curve].append(float(weight_map(image, WeightSpec(curve=curve)).mean()))
    means = {curve: np.mean(values) for curve, values in maps.items()}
    for curve, expected in {"C1": 1.48, "C2": 1.06, "C3": 2.90, "C4": 1.16, "C5": 2.16}.items():
        assert means[curve] == pytest.approx(expected, rel=0.05)


# Weights that follow the rendering's error


def test_error_weights_by_hand() -> None:
    target = torch.zeros(2, 1, 3)
    prediction = torch.tensor([[[0.0, 0.3, 0.6]], [[0.0, 0.1, 0.2]]])  # mean errors 0, 0.2, 0.4
    normalised = torch.tensor([[[1.0, 1.0, 0.25]]])
    spec = WeightSpec(curve="C1", beta=10.0, error=0.5, error_blur=0.0)
    mixed = [0.0, 0.2**0.5, (0.25 * 0.4) ** 0.5]
    expected = torch.tensor([[[1.0 + 10.0 * value / max(mixed) for value in mixed]]])
    assert torch.allclose(error_weight_map(prediction, target, spec, normalised=normalised), expected, atol=1e-5)
    pair = [torch.stack([x, x]) for x in (prediction, target, normalised)]
    batch = error_weight_map(pair[0], pair[1], spec, normalised=pair[2])
    assert torch.equal(batch[0], batch[1]) and torch.allclose(batch[0], expected, atol=1e-5)


@pytest.mark.skipif(sys.version_info < (3, 8), reason="this scipy has no axes=")
def test_the_error_is_averaged_as_scipy_does() -> None:
    image = torch.rand(1, 17, 23, dtype=torch.float64)
    expected = gaussian_filter(image[0].numpy(), 1.5, mode="mirror", radius=5)
    assert torch.allclose(gaussian_blur(image, 1.5)[0], torch.from_numpy(expected), atol=1e-12)


def test_a_map_that_needs_the_rendering_is_refused_without_it() -> None:
    with pytest.raises(LegsError, match="need the rendering too"):
        weight_map(torch.rand(3, 8, 8), WeightSpec(error=1.0))


@pytest.mark.parametrize("setting", [{"error": 1.5}, {"error": -0.1}, {"error_blur": -1.0}])
def test_error_settings_out_of_range(setting) -> None:
    with pytest.raises(LegsError, match=next(iter(setting))):
        WeightSpec(**setting)


def test_error_weights_in_the_loss_and_in_the_drop_in() -> None:
    spec = WeightSpec(curve="C1", percentile=99.0, normalise="mean", error=0.5)
    target, prediction = torch.rand(3, 20, 24), torch.rand(3, 20, 24, requires_grad=True)
    weight = error_weight_map(prediction, target, spec)
    expected = (weight * (prediction - target).abs()).mean()
    torch.testing.assert_close(legs_loss(prediction, target, spec, lambda_dssim=0.0), expected)
    torch.testing.assert_close(
        legs_loss(prediction, target, spec), 0.8 * expected + 0.2 * d_ssim(prediction, target), rtol=1e-4, atol=1e-6
    )
    configure(spec)
    try:
        for _ in range(2):  # the second time the response is remembered, the error is not
            torch.testing.assert_close(l1_loss(prediction, target), expected)
        flipped = l1_loss(prediction.movedim(0, -1), target.movedim(0, -1))
        torch.testing.assert_close(flipped, expected)
        other = (prediction.detach() * 0.5).requires_grad_()
        weight = error_weight_map(other, target, spec)
        torch.testing.assert_close(l1_loss(other, target), (weight * (other - target).abs()).mean())
    finally:
        configure("legs")


def test_scale_multiplies_the_map() -> None:
    image = torch.rand(3, 9, 9)
    torch.testing.assert_close(weight_map(image, WeightSpec(scale=0.6)), 0.6 * weight_map(image, "legs"))
    assert torch.equal(weight_map(image, WeightSpec(beta=0.0, scale=3.0)), torch.full((1, 9, 9), 3.0))
