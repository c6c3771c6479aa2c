"""SSIM: 3DGS's formula to the last bit, skimage and torchmetrics, gradients, paddings."""

from __future__ import annotations

import importlib
import math

import pytest
import torch
import torch.nn.functional as F

from legs_loss import LegsError, d_ssim, ssim

module = importlib.import_module("legs_loss.similarity")


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
    assert torch.equal(ssim(prediction, target, channels_last=False), formula_of_3dgs(prediction, target))


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
    prediction, target = pair(3, 12, 13, dtype=torch.float64)
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
    last = ssim(prediction.movedim(1, -1), target.movedim(1, -1))
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


class TestDropIn:
    """It stands in for `ssim(img1, img2, window_size=11, size_average=True)` of 3DGS."""

    def test_3dgs_arguments_by_place_and_by_name(self):
        prediction, target = pair(2, 3, 24, 31)
        value = formula_of_3dgs(prediction, target)
        assert torch.equal(ssim(prediction, target, 11), value)
        assert torch.equal(ssim(prediction, target, 11, True), value)
        assert torch.equal(ssim(prediction, target, window_size=11, size_average=True), value)
        assert torch.equal(ssim(img1=prediction, img2=target), value)
        assert torch.equal(ssim(img2=target, img1=prediction, size_average=True, window_size=11), value)
        each = torch.stack([formula_of_3dgs(*images) for images in zip(prediction, target)])
        torch.testing.assert_close(ssim(prediction, target, size_average=False), each)
        torch.testing.assert_close(ssim(prediction, target, 11, False), each)

    def test_another_window(self):
        kornia = pytest.importorskip("kornia")
        prediction, target = pair(1, 3, 24, 31, dtype=torch.float64)
        kernel = kornia.filters.get_gaussian_kernel2d((7, 7), (1.5, 1.5)).double()
        blur = lambda image: kornia.filters.filter2d(image, kernel, "constant")
        mean1, mean2 = blur(prediction), blur(target)
        variances = blur(prediction**2) - mean1**2 + blur(target**2) - mean2**2
        covariance = blur(prediction * target) - mean1 * mean2
        expected = (2 * mean1 * mean2 + 1e-4) * (2 * covariance + 9e-4)
        expected = expected / ((mean1**2 + mean2**2 + 1e-4) * (variances + 9e-4))
        assert float(ssim(prediction, target, 7)) == pytest.approx(float(expected.mean()), abs=1e-6)
        with pytest.raises(LegsError, match="odd number of pixels, got 8"):
            ssim(prediction, target, 8)

    @pytest.mark.parametrize("trained", ["first", "second"])
    def test_a_training_step_is_fused_with_the_same_gradient(self, trained):
        pytest.importorskip("numba")
        images = list(pair(3, 40, 50))
        index = 0 if trained == "first" else 1
        images[index].requires_grad_()
        value = ssim(*images)
        assert type(value.grad_fn).__name__ == "_FusedLossBackward"
        exact = [image.detach().double() for image in images]
        exact[index].requires_grad_()
        expected = formula_of_3dgs(*exact)
        assert value.item() == pytest.approx(expected.item(), abs=1e-5)
        gradient = torch.autograd.grad(value, images[index])[0]
        reference = torch.autograd.grad(expected, exact[index])[0]
        assert float((gradient - reference).norm() / reference.norm()) < 1e-4

    def test_evaluation_is_3dgs_own_to_the_last_bit(self):
        prediction, target = pair(3, 24, 31)
        with torch.no_grad():
            assert torch.equal(ssim(prediction.requires_grad_(), target), formula_of_3dgs(prediction, target))

    def test_with_legs_off_a_training_step_is_3dgs_own_to_the_last_bit(self, monkeypatch):
        monkeypatch.setenv("LEGS_OFF", "1")
        prediction, target = pair(3, 40, 50)
        value = ssim(prediction.requires_grad_(), target)
        expected = formula_of_3dgs(prediction, target)
        assert torch.equal(value, expected)
        assert torch.equal(*(torch.autograd.grad(each, prediction)[0] for each in (value, expected)))

    def test_a_batch_of_one_beside_a_single_image(self):
        prediction, target = pair(3, 24, 31)
        for images in ((prediction[None], target), (prediction, target[None])):
            assert torch.equal(ssim(*images), formula_of_3dgs(prediction, target))
        with pytest.raises(LegsError, match="differ in shape"):
            ssim(torch.stack([prediction] * 2), target)

    def test_both_images_may_learn(self):
        images = [image.requires_grad_() for image in pair(3, 24, 31)]
        assert all(gradient.abs().sum() > 0 for gradient in torch.autograd.grad(ssim(*images), images))


def test_the_window_is_made_once_and_never_in_a_mode_that_spoils_it(monkeypatch):
    module._kept_window.cache_clear()
    made = []
    new_window = module._new_window
    monkeypatch.setattr(module, "_new_window", lambda *args: made.append(args) or new_window(*args))
    prediction, target = pair(3, 16, 16)
    with torch.inference_mode():
        ssim(prediction, target)
    for _ in range(3):
        d_ssim(prediction.requires_grad_(), target).backward()
    assert made == [(3, 11)]
    ssim(prediction.detach().double(), target.double())
    assert len(made) == 2  # one a type
    fake = pytest.importorskip("torch._subclasses.fake_tensor").FakeTensorMode()
    module._kept_window.cache_clear()
    with fake:
        ssim(torch.empty(1, 12, 12), torch.empty(1, 12, 12))
    assert module._kept_window.cache_info().currsize == 0


@pytest.mark.skipif(not hasattr(torch.device, "__enter__"), reason="torch 2 makes a device a context")
def test_the_window_is_the_same_whatever_the_default_device():
    """A GPU sums its taps in another order, and one that is normalised by the next float moves the value by 1e-5."""
    from legs_loss.similarity import _new_window

    expected = _new_window(3, 11)
    with torch.device("meta"):
        found = _new_window(3, 11)
    assert found.device.type == "cpu" and torch.equal(found, expected)
