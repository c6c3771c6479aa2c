"""SSIM: 3DGS's formula to the last bit, skimage and torchmetrics, gradients, paddings."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F

from legs_loss import LegsError, d_ssim, ssim


def formula_of_3dgs(first, second):
    """SSIM as the 3DGS paper's code defines it: five blurs with an 11x11 window of sigma 1.5, zero padding."""
    channels = first.size(-3)
    taps = torch.tensor([math.exp(-((i - 5) ** 2) / (2 * 1.5**2)) for i in range(11)])
    taps = (taps / taps.sum()).unsqueeze(1)
    window = (taps @ taps.t()).expand(channels, 1, 11, 11).contiguous().type_as(first)
    blur = lambda image: F.conv2d(image, window, padding=5, groups=channels)
    mu1, mu2 = blur(first), blur(second)
    mu1_sq, mu2_sq, mu1_mu2 = mu1.pow(2), mu2.pow(2), mu1 * mu2
    s1, s2, s12 = blur(first * first) - mu1_sq, blur(second * second) - mu2_sq, blur(first * second) - mu1_mu2
    return (
        ((2 * mu1_mu2 + 0.01**2) * (2 * s12 + 0.03**2)) / ((mu1_sq + mu2_sq + 0.01**2) * (s1 + s2 + 0.03**2))
    ).mean()


def pair(*shape, dtype=torch.float32):
    target = torch.rand(shape, dtype=dtype)
    return (target + 0.2 * torch.rand(shape, dtype=dtype)).clamp(0, 1), target


@pytest.mark.parametrize("shape", [(3, 24, 31), (1, 11, 11), (3, 5, 4), (2, 3, 16, 20), (3, 1, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_3dgs_own_to_the_last_bit(shape, dtype):
    prediction, target = pair(*shape, dtype=dtype)
    assert torch.equal(ssim(prediction, target), formula_of_3dgs(prediction, target))


def test_valid_windows_equal_skimage():
    skimage = pytest.importorskip("skimage.metrics")
    prediction, target = pair(3, 40, 50, dtype=torch.float64)
    # skimage crops to the windows inside the image: five pixels a side for an eleven-pixel window.
    expected = skimage.structural_similarity(
        prediction.numpy(),
        target.numpy(),
        channel_axis=0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    assert float(ssim(prediction, target, padding="valid")) == pytest.approx(expected, abs=1e-7)


def test_reflected_padding_equals_torchmetrics():
    functional = pytest.importorskip("torchmetrics.functional.image")
    prediction, target = pair(2, 3, 40, 50, dtype=torch.float64)
    expected = functional.structural_similarity_index_measure(
        prediction, target, gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0
    )
    assert float(ssim(prediction, target, padding="reflect")) == pytest.approx(float(expected), abs=1e-7)


@pytest.mark.parametrize("mode", ["reflect", "replicate"])
def test_paddings_equal_a_padded_valid(mode):
    prediction, target = pair(3, 14, 17, dtype=torch.float64)
    grow = lambda image: F.pad(image, (5, 5, 5, 5), mode=mode)
    expected = ssim(grow(prediction), grow(target), padding="valid")
    assert torch.equal(ssim(prediction, target, padding=mode), expected)


def test_kornia_agrees():
    metrics = pytest.importorskip("kornia.metrics")
    prediction, target = pair(1, 3, 30, 30, dtype=torch.float64)
    expected = metrics.ssim(prediction, target, window_size=11, padding="valid").mean()
    assert float(ssim(prediction, target, padding="valid")) == pytest.approx(float(expected), abs=1e-5)


@pytest.mark.parametrize("padding", ["zeros", "reflect", "replicate", "valid"])
def test_gradcheck(padding):
    prediction, target = pair(2, 12, 13, dtype=torch.float64)
    prediction.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: ssim(p, target, padding=padding), (prediction,), fast_mode=True)


def test_range_and_complement():
    prediction, target = pair(3, 20, 20)
    assert float(ssim(target, target)) == pytest.approx(1.0)
    assert float(ssim(target, 1 - target)) < 0.0
    assert torch.equal(d_ssim(prediction, target), 1 - ssim(prediction, target))


def test_layouts_and_half_precision():
    prediction, target = pair(2, 3, 16, 16)
    value = ssim(prediction, target)
    last = ssim(prediction.movedim(1, -1), target.movedim(1, -1), channels_last=True)
    torch.testing.assert_close(last, value)
    half = ssim(prediction.half(), target.half())
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, value, atol=2e-3, rtol=0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(ssim(prediction, target), value)


def test_bad_input_is_named():
    with pytest.raises(LegsError, match=r"\[3, 8, 8\].*\[3, 8, 9\]"):
        ssim(torch.rand(3, 8, 8), torch.rand(3, 8, 9))
    with pytest.raises(LegsError, match="no padding is named 'same'"):
        ssim(torch.rand(3, 8, 8), torch.rand(3, 8, 8), padding="same")
    with pytest.raises(LegsError, match="at least 11 pixels"):
        ssim(torch.rand(3, 8, 8), torch.rand(3, 8, 8), padding="valid")
