"""Masks and maps around every backend, against means over the pixels that count in float64."""

from __future__ import annotations

import pytest
import torch

from legs_loss import weight_map
from legs_loss.kernels.contract import L1, terms_of
from legs_loss.similarity import d_ssim
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.kernels.support import images
from tests.kernels.test_backward import backend, backend_named  # noqa: F401

LEGS = PRESETS["legs"]
SHARE = 0.2


def masks(shape):
    height, width = shape[-2:]
    each = (*shape[:-3], 1, height, width)
    torch.manual_seed(1)
    return {
        "bool": torch.rand(1, height, width) > 0.4,
        "floats of each view": torch.rand(each) * (torch.rand(each) > 0.3),
        "one pixel": (torch.arange(height * width) == 7).reshape(1, height, width),
        "nothing": torch.zeros(1, height, width),
    }


def expected_l1(prediction, target, weight, mask, renormalise):
    """sum(M * W * |d|) / sum(M) in float64, the mean over channels inside."""
    error = (prediction.double() - target.double()).abs().mean(-3, keepdim=True)
    counted = (mask.double() if mask is not None else torch.ones(())).expand_as(error)
    total = (counted * weight.double() * error).sum()
    return total / (counted.sum().clamp(min=1e-30) if renormalise else error.numel())


def expected_d_ssim(prediction, target, mask, renormalise):
    """sum(1 - SSIM) over the image, no difference where the mask is 0, by the number of the other pixels."""
    counts = (mask > 0).expand(prediction[..., :1, :, :].shape)
    seen = torch.where(counts, prediction, target.double())
    share = max(float(counts.double().mean()), 1.0 / counts.numel()) if renormalise else 1.0
    return d_ssim(seen, target.double()) / share


@pytest.mark.parametrize("renormalise", [False, True])
@pytest.mark.parametrize("kind", ["bool", "floats of each view", "one pixel", "nothing"])
@pytest.mark.parametrize("shape", [(3, 24, 40), (2, 3, 37, 130)])
def test_a_masked_loss_is_the_mean_over_what_counts(backend, shape, kind, renormalise):  # noqa: F811
    prediction, target = images(shape)
    mask, own = masks(shape)[kind], 0.5 + torch.rand(1, *shape[-2:])
    made = weight_map(target, LEGS)
    cases = {
        "none": (Weights(), torch.ones(())),
        "spec": (Weights(spec=LEGS), made),
        "map": (Weights(map=own), own),
        "spec and map": (Weights(spec=LEGS, map=own), made * own),
    }
    for weights, weight in cases.values():
        weights = weights.masked(mask, renormalise)
        for share in (0.0, SHARE):
            loss = of_backend(backend, prediction, target, weights, share)
            exact = prediction.detach().double().requires_grad_()
            expected = (1.0 - share) * expected_l1(exact, target, weight, mask, renormalise)
            if share:
                expected = expected + share * expected_d_ssim(exact, target, mask, renormalise)
            (gradient,), (wanted,) = torch.autograd.grad(loss, prediction), torch.autograd.grad(expected, exact)
            large = max(1.0, float(wanted.abs().max()))
            close = 1e-6  # rounding is of all pixels, and divided by what counts
            if share and renormalise:
                close = 1e-4 if kind == "one pixel" else 1e-5
            assert abs(loss.item() - expected.item()) <= close * max(1.0, abs(expected.item()))
            assert float((gradient.double() - wanted).abs().max()) <= close * large
            assert not gradient[(mask == 0).expand(gradient.shape)].any()


def of_backend(backend, prediction, target, weights, share):  # noqa: F811
    seen = weights.hidden(prediction, target) if share else prediction
    one = backend.loss(terms_of(share), seen, target, weights) if share else backend.loss(L1, seen, target, weights)
    return weights.of_what_counts(one)


def test_without_a_mask_not_a_bit_changes(backend):  # noqa: F811
    prediction, target = images((3, 50, 300))
    ones = torch.ones(1, 50, 300, dtype=torch.bool)
    for weights in (Weights(), Weights(spec=LEGS), Weights(map=weight_map(target, LEGS))):
        results = []
        for masked in (weights, weights.masked(ones, False), weights.masked(ones)):
            loss = of_backend(backend, prediction, target, masked, SHARE)
            results.append((loss, *torch.autograd.grad(loss, prediction)))
        for other in results[1:]:
            assert all(torch.equal(a, b) for a, b in zip(results[0], other))


def test_a_prediction_without_a_number_where_nothing_counts_has_no_gradient(backend):  # noqa: F811
    prediction, target = images((3, 24, 40))
    mask = torch.ones(1, 24, 40, dtype=torch.bool)
    mask[0, 3:9] = False
    with torch.no_grad():
        prediction[:, 4, 5] = float("nan")
    loss = of_backend(backend, prediction, target, Weights(spec=LEGS).masked(mask), 0.0)
    (gradient,) = torch.autograd.grad(loss, prediction)
    assert torch.isfinite(gradient).all() and not gradient[:, 3:9].any()
