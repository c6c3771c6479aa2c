"""One reader of shapes: every public function takes an image in each layout, and computes the same."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss import (
    LegsError,
    LEGSLoss,
    configure,
    d_ssim,
    l1_loss,
    legs_loss,
    response,
    ssim,
    weight_map,
    weighted_l1,
)
from legs_loss.images import read_layout

SIDES = st.integers(5, 14)  # pixels: no side can be taken for a number of channels


def transposed(image):
    return image.movedim(-3, -1)


@st.composite
def pairs(draw):
    """Draw a prediction and a target [C, H, W], [B, C, H, W] or [B, V, C, H, W], and one value a pixel of them."""
    batch = draw(st.sampled_from([(), (1,), (2,), (2, 3)]))
    channels, height, width = draw(st.sampled_from([1, 3, 4])), draw(SIDES), draw(SIDES)
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31 - 1)))

    def drawn(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    shape = (*batch, channels, height, width)
    return drawn(*shape), drawn(*shape), drawn(*batch, 1, height, width)


def values_of(prediction, target, values):
    """Return what each public function makes of a pair, and of one value a pixel."""
    yield l1_loss(prediction, target)
    yield l1_loss(prediction, target, mask=values)
    yield l1_loss(prediction, target, own=lambda a, b: (a - b).abs().sum())
    yield legs_loss(prediction, target)
    yield legs_loss(prediction, target, weight=1 + values, mask=values, renormalise=True)
    yield LEGSLoss("eggs")(prediction, target, mask=values)
    yield weighted_l1(prediction, target)
    yield weighted_l1(prediction, target, 1 + values, values)
    yield ssim(prediction, target)
    yield d_ssim(prediction, target)


@settings(max_examples=12, deadline=None)
@given(pairs())
def test_transposed_images_have_the_same_value_and_the_transposed_gradient(drawn):
    configure("legs")
    prediction, target, values = drawn
    first = prediction.clone().requires_grad_()
    last = transposed(prediction).contiguous().requires_grad_()
    others = values_of(last, transposed(target).contiguous(), transposed(values))
    for expected, found in zip(values_of(first, target, values), others):
        torch.testing.assert_close(found, expected)
        gradients = torch.autograd.grad(expected, first)[0], torch.autograd.grad(found, last)[0]
        torch.testing.assert_close(gradients[1], transposed(gradients[0]))


@settings(max_examples=12, deadline=None)
@given(pairs())
def test_maps_stand_as_their_image_does(drawn):
    _, target, _ = drawn
    for function in (weight_map, response):
        expected = function(target)
        assert expected.shape == (*target.shape[:-3], 1, *target.shape[-2:])
        torch.testing.assert_close(function(transposed(target)), transposed(expected))
    error = l1_loss(torch.zeros_like(target).requires_grad_(), target, reduction="none")
    other = l1_loss(torch.zeros_like(transposed(target)).requires_grad_(), transposed(target), reduction="none")
    torch.testing.assert_close(other, transposed(error))


@settings(max_examples=12, deadline=None)
@given(pairs())
def test_more_axes_in_front_are_one_batch(drawn):
    prediction, target, values = drawn
    flat = [tensor.reshape(-1, *tensor.shape[-3:]).clone() for tensor in drawn]
    for trained in (flat[0], prediction):
        trained.requires_grad_()
    for expected, found in zip(values_of(*flat), values_of(prediction, target, values)):
        torch.testing.assert_close(found, expected)


def test_a_gray_image_without_a_channel():
    prediction, target = torch.rand(7, 9, requires_grad=True), torch.rand(7, 9)
    values = torch.rand(1, 7, 9)
    for expected, found in zip(
        values_of(prediction[None], target[None], values), values_of(prediction, target, values[0])
    ):
        torch.testing.assert_close(found, expected)
    assert torch.equal(weight_map(target), weight_map(target[None])[0])
    assert l1_loss(prediction, target, reduction="none").shape == (7, 9)


@pytest.mark.parametrize(
    ("shape", "last"),
    [
        ((3, 20, 30), False),
        ((20, 30, 3), True),
        ((1, 20, 30), False),
        ((20, 30, 1), True),
        ((1, 20, 30, 3), True),
        ((4, 20, 30, 3), True),
        ((3, 1, 20, 30), False),
        ((3, 3, 20, 30), False),
        ((2, 5, 20, 30, 4), True),
        ((3, 1, 300), False),
        ((300, 1, 3), True),
    ],
)
def test_layouts_that_the_shape_shows(shape, last):
    assert read_layout(torch.empty(shape)).channels_last is last
    assert read_layout(torch.empty(shape), last).channels_last is last


@pytest.mark.parametrize("shape", [(3, 20, 4), (3, 20, 3), (1, 20, 1), (2, 3, 20, 3), (1, 4, 3), (2, 5, 1, 20, 4)])
@pytest.mark.parametrize("function", [weight_map, response])
def test_a_shape_that_reads_either_way_is_refused_with_what_to_pass(shape, function):
    image = torch.rand(shape)
    with pytest.raises(
        LegsError, match=rf"{list(shape)} may have .* channels_last=False .* channels_last=True".replace("[", r"\[")
    ):
        function(image)
    *batch, first, middle, last = shape
    assert function(image, channels_last=False).shape == (*batch, 1, middle, last)
    assert function(image, channels_last=True).shape == (*batch, first, middle, 1)


@pytest.mark.parametrize("shape", [(16, 20, 30), (2, 20, 30), (2, 5, 20, 30)])
@pytest.mark.parametrize("function", [weight_map, response])
def test_gray_images_in_a_row_are_no_channels_of_one(shape, function):
    image = torch.rand(shape)
    with pytest.raises(LegsError, match=rf"; gray images are \[\.\.\., {shape[-3]}, 1, H, W\]"):
        function(image)
    assert function(image.unsqueeze(-3)).shape == (*shape[:-2], 1, *shape[-2:])
    assert function(image, channels_last=False).shape == (*shape[:-3], 1, *shape[-2:])


@pytest.mark.parametrize("shape", [(500,), (500, 3), (3, 500), (500, 4), (1, 9), (500, 1)])
def test_a_list_of_pixels_is_no_gray_image(shape):
    pixels, message = torch.rand(shape, requires_grad=True), "is a list of pixels: a weight map needs the whole image"
    for function in (legs_loss, weighted_l1, ssim, l1_loss, partial(l1_loss, own=torch.nn.functional.l1_loss)):
        with pytest.raises(LegsError, match=message):
            function(pixels, torch.rand(shape))
    for function in (weight_map, response):
        with pytest.raises(LegsError, match=message):
            function(pixels)
    with torch.no_grad():
        assert l1_loss(pixels, torch.zeros(shape)) == pixels.mean()


def test_what_is_not_one_image_and_its_photograph_is_refused():
    image = torch.rand(3, 20, 30, requires_grad=True)
    for function in (legs_loss, weighted_l1, ssim, l1_loss):
        with pytest.raises(LegsError, match=r"\[3, 20, 30\] and target \[20, 30, 3\] differ in shape"):
            function(image, torch.rand(20, 30, 3))
        with pytest.raises(LegsError, match=r"got \[\]"):
            function(image[0, 0, 0], torch.rand(()))
