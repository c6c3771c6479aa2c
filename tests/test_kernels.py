"""The fused numba loss against the torch reference in float64."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss import legs_loss, weight_map

pytest.importorskip("numba")

from legs_loss.kernels.numba_loss import fused_loss


def compare(shape, weighted, lambda_dssim, offset=0.1):
    target = torch.rand(shape)
    prediction = (0.8 * target + offset * torch.rand(shape)).requires_grad_()
    weight = weight_map(target) if weighted else None
    loss = fused_loss(prediction, target, weight, lambda_dssim)
    loss.backward()
    exact = prediction.detach().double().requires_grad_()
    expected = legs_loss(
        exact,
        target.double(),
        "3dgs",
        None if weight is None else weight.double(),
        lambda_dssim=lambda_dssim,
    )
    expected.backward()
    assert loss.dtype == torch.float32 and loss.shape == ()
    assert loss.item() == pytest.approx(expected.item(), rel=2e-5, abs=1e-6)
    error = (prediction.grad.double() - exact.grad).norm() / exact.grad.norm()
    assert float(error) < 2e-5


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("shape", [(3, 1, 1), (1, 5, 7), (3, 40, 300), (2, 3, 30, 17), (3, 150, 530), (4, 11, 257)])
def test_value_and_gradient_equal_the_reference(shape, weighted):
    compare(shape, weighted, 0.2)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 140), st.integers(1, 300), st.integers(1, 4), st.floats(0, 1))
def test_any_size_and_share(height, width, channels, lambda_dssim):
    compare((channels, height, width), height % 2 == 0, lambda_dssim)


def test_gradient_is_zero_for_an_equal_prediction():
    target = torch.rand(3, 20, 20)
    prediction = target.clone().requires_grad_()
    loss = fused_loss(prediction, target)
    loss.backward()
    assert loss.item() == pytest.approx(0.0, abs=1e-6)
    assert float(prediction.grad.abs().max()) < 1e-7


def test_it_repeats_bit_for_bit_on_any_number_of_threads():
    import numba

    target = torch.rand(3, 300, 300)
    results = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS), 1):
        numba.set_num_threads(threads)
        prediction = (0.9 * target).requires_grad_()
        loss = fused_loss(prediction, target)
        loss.backward()
        results.append((loss.item(), prediction.grad))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for value, gradient in results[1:]:
        assert value == results[0][0]
        assert torch.equal(gradient, results[0][1])


def test_non_contiguous_images_and_a_scaled_loss():
    target = torch.rand(20, 30, 3).movedim(-1, 0)
    prediction = torch.rand(20, 30, 3, requires_grad=True)
    (3.0 * fused_loss(prediction.movedim(-1, 0), target)).backward()
    other = prediction.detach().clone().requires_grad_()
    (3.0 * legs_loss(other.movedim(-1, 0), target, "3dgs")).backward()
    torch.testing.assert_close(prediction.grad, other.grad, rtol=1e-4, atol=1e-8)
