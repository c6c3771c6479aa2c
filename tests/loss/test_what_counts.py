"""A masked pixel dilutes neither term: against the crop where the mask is a rectangle, with SSIM by scipy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from legs_loss import LEGSLoss, d_ssim, l1_loss, legs_loss, ssim, weight_map, weighted_l1

HEIGHT, WIDTH, REACH = 60, 90, 5
TOP, BOTTOM, LEFT, RIGHT = 12, 48, 20, 50  # the rectangle, 20% of the image


def rectangle(channels_last=False):
    mask = torch.zeros(HEIGHT, WIDTH)
    mask[TOP:BOTTOM, LEFT:RIGHT] = 1.0
    return mask


def crop(image, border=0):
    return image[..., TOP + border : BOTTOM - border, LEFT + border : RIGHT - border]


def images(inside=True):
    """An image and a rendering that differs everywhere; or, to have no window across the border, well inside alone."""
    torch.manual_seed(2)
    target = torch.rand(3, HEIGHT, WIDTH, dtype=torch.float64)
    prediction = (target + 0.3 * torch.rand(3, HEIGHT, WIDTH, dtype=torch.float64)).clamp(0, 1)
    if inside:
        same = target.clone()
        crop(same, 2 * REACH)[:] = crop(prediction, 2 * REACH)
        prediction = torch.where(rectangle() > 0, same, prediction)  # it still differs wherever nothing counts
    return prediction.requires_grad_(), target


def ssim_by_scipy(first, second):
    """The SSIM of every pixel [C, H, W], zero padding, in float64."""
    ndimage = pytest.importorskip("scipy.ndimage")
    taps = np.exp(-((np.arange(11) - REACH) ** 2) / (2 * 1.5**2))
    taps /= taps.sum()

    def blur(image):
        for axis in (1, 2):
            image = ndimage.convolve1d(image, taps, axis=axis, mode="constant")
        return image

    x, y = first.detach().numpy(), second.detach().numpy()
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, both = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    above = (2 * mean_x * mean_y + 1e-4) * (2 * both + 9e-4)
    return above / ((mean_x**2 + mean_y**2 + 1e-4) * (var_x + var_y + 9e-4))


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("preset", ["legs", "3dgs"])
def test_the_loss_of_a_rectangle_is_that_of_its_crop(preset, share):
    """All windows that see a difference lie in the crop, so this is exact but for the window's rounded taps."""
    prediction, target = images()
    found = legs_loss(prediction, target, preset, mask=rectangle(), renormalise=True, lambda_dssim=share)
    weight = crop(weight_map(target, preset))[0]
    l1 = (weight * crop(prediction - target).abs().mean(0)).mean()
    structural = 1.0 - crop(torch.from_numpy(ssim_by_scipy(crop_alone(prediction, target), target))).mean()
    expected = (1.0 - share) * l1 + share * structural
    assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-6)
    alone, photograph = crop(prediction), crop(target)
    theirs = legs_loss(alone, photograph, weight=weight, lambda_dssim=share)
    torch.testing.assert_close(found, theirs, rtol=1e-6, atol=0)
    gradients = [torch.autograd.grad(loss, prediction)[0] for loss in (found, theirs)]
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=1e-10)
    half = legs_loss(prediction, target, preset, mask=rectangle(), lambda_dssim=share)  # as a share of the whole image
    torch.testing.assert_close(half, found * rectangle().double().mean(), rtol=1e-6, atol=0)


def crop_alone(prediction, target):
    return torch.where(rectangle() > 0, prediction.detach(), target)


def test_where_windows_reach_across_the_border_each_difference_counts_once():
    prediction, target = images(inside=False)
    map_ = 1.0 - ssim_by_scipy(crop_alone(prediction, target), target)
    expected = map_.sum() / (3 * (BOTTOM - TOP) * (RIGHT - LEFT))
    found = 1.0 - ssim(prediction, target, mask=rectangle())
    assert float(found.detach()) == pytest.approx(expected, rel=1e-6)
    inner = crop(torch.from_numpy(map_), REACH)
    theirs = 1.0 - torch.from_numpy(ssim_by_scipy(crop(prediction), crop(target)))
    torch.testing.assert_close(inner, theirs[:, REACH:-REACH, REACH:-REACH])  # up to the window's border
    # Far more than the same term over all pixels, which masked ones diluted to a fifth.
    assert float(found.detach()) > 4.5 * float(d_ssim(crop_alone(prediction, target), target))


@pytest.mark.parametrize("padding", ["zeros", "reflect", "replicate", "valid"])
def test_every_padding(padding):
    prediction, target = images()
    theirs = ssim(crop(prediction), crop(target), padding="zeros")
    found = ssim(prediction, target, padding=padding, mask=rectangle())
    torch.testing.assert_close(found, theirs, rtol=1e-6, atol=0)
    whole = legs_loss(prediction, target, "3dgs", mask=rectangle(), renormalise=True, padding=padding)
    expected = 0.8 * crop(prediction - target).abs().mean() + 0.2 * (1.0 - theirs)
    torch.testing.assert_close(whole, expected, rtol=1e-6, atol=0)


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_every_front_end_and_backend_means_the_same(monkeypatch, backend):
    monkeypatch.setenv("LEGS_BACKEND", backend)
    if backend == "numba":
        pytest.importorskip("numba")
    prediction, target = images(inside=False)
    expected = 0.8 * weighted_l1(prediction, target, weight_map(target), rectangle(), renormalise=True)
    expected = expected + 0.2 * (1.0 - ssim(prediction, target, mask=rectangle()))
    image, photograph = prediction.detach().float().requires_grad_(), target.float()
    last = image.movedim(0, -1)[None], photograph.movedim(0, -1)[None]
    for found in (
        legs_loss(image, photograph, mask=rectangle(), renormalise=True),
        LEGSLoss(renormalise=True)(image, photograph, mask=rectangle()[None] > 0),
        legs_loss(*last, mask=rectangle()[None, :, :, None], renormalise=True),
        legs_loss(image, photograph, weight=weight_map(photograph), mask=rectangle().double(), renormalise=True),
        0.8 * weighted_l1(image, photograph, weight_map(photograph), rectangle(), renormalise=True)
        + 0.2 * (1.0 - ssim(photograph, image, mask=rectangle())),
    ):
        assert found.dtype == torch.float32
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)
    assert float(l1_loss(image, photograph, mask=rectangle())) < float(expected)  # diluted, unless it is asked for


def test_a_batch_is_the_mean_over_what_counts_of_all_of_it():
    prediction, target = (torch.stack([image, image.flip(-1)]) for image in images())
    masks = torch.stack([rectangle(), torch.ones(HEIGHT, WIDTH)])[:, None]
    found = legs_loss(prediction, target, "3dgs", mask=masks, renormalise=True, lambda_dssim=1.0)
    parts = [1.0 - ssim(*pair) for pair in zip(crop(prediction[0])[None], crop(target[0])[None])]
    counts = [(BOTTOM - TOP) * (RIGHT - LEFT), HEIGHT * WIDTH]
    parts = [1.0 - ssim(crop(prediction[0]), crop(target[0])), 1.0 - ssim(prediction[1], target[1])]
    expected = (counts[0] * parts[0] + counts[1] * parts[1]) / sum(counts)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    each = ssim(prediction, target, size_average=False, mask=masks)
    torch.testing.assert_close(each, 1.0 - torch.stack(parts), rtol=1e-6, atol=0)


def test_a_grey_pixel_counts_in_part_in_the_l1_and_whole_in_ssim():
    prediction, target = images(inside=False)
    whole = legs_loss(prediction, target, "3dgs")
    grey = legs_loss(prediction, target, "3dgs", mask=torch.full((HEIGHT, WIDTH), 0.25), renormalise=True)
    torch.testing.assert_close(grey, whole)
    mask = torch.where(rectangle() > 0, 1.0, 0.5)
    l1 = (mask * (prediction - target).abs().mean(0)).sum() / mask.sum()
    found = legs_loss(prediction, target, "3dgs", mask=mask, renormalise=True)
    torch.testing.assert_close(found, 0.8 * l1 + 0.2 * d_ssim(prediction, target))


def test_where_nothing_counts_the_loss_and_its_gradient_are_zero():
    prediction, target = images(inside=False)
    for renormalise in (False, True):
        loss = legs_loss(prediction, target, mask=torch.zeros(HEIGHT, WIDTH), renormalise=renormalise)
        assert abs(float(loss.detach())) < 1e-9
        assert not torch.autograd.grad(loss, prediction)[0].any()


@pytest.mark.parametrize("mask", [rectangle()[8:30, 14:40], torch.linspace(0, 1, 22 * 26).reshape(22, 26)])
def test_gradients(mask):
    torch.manual_seed(3)
    prediction = torch.rand(3, 22, 26, dtype=torch.float64, requires_grad=True)
    target = torch.rand(3, 22, 26, dtype=torch.float64)
    for function in (
        lambda image: legs_loss(image, target, mask=mask, renormalise=True),
        lambda image: ssim(image, target, mask=mask),
    ):
        assert torch.autograd.gradcheck(function, (prediction,), fast_mode=True)
