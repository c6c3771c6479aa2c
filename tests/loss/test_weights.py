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

from legs_loss import LegsError, WeightSpec, weight_map
from legs_loss.responses import gaussian_blur
from legs_loss.weights import weight_from_response
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
    with pytest.raises(LegsError, match=r"\[3, 4, 5\] has values that are NaN or infinite"):
        weight_map(image)


def test_an_8_bit_range_is_named():
    with pytest.raises(LegsError, match="255"):
        weight_map(torch.rand(3, 4, 5) * 255)


def test_a_nan_that_is_not_looked_for_is_not_hidden():
    from legs_loss.responses import normalise_response, response

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


@pytest.mark.skipif(sys.version_info < (3, 8), reason="this scipy has no axes=")
def test_an_image_is_blurred_as_scipy_does() -> None:
    image = torch.rand(1, 17, 23, dtype=torch.float64)
    expected = gaussian_filter(image[0].numpy(), 1.5, mode="mirror", radius=5)
    assert torch.allclose(gaussian_blur(image, 1.5)[0], torch.from_numpy(expected), atol=1e-12)
