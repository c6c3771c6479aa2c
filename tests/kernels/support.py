"""Images for the tests of the fused losses, the comparison with the reference, and which backend computed a loss."""

from __future__ import annotations

import pytest
import torch

from legs_loss import WeightSpec, legs_loss
from legs_loss.kernels import backends
from legs_loss.kernels.contract import L1, SSIM, terms_of
from legs_loss.weights import Weights

_NONE = Weights()


def images(shape, offset=0.1):
    target = torch.rand(shape)
    return (0.8 * target + offset * torch.rand(shape)).requires_grad_(), target


def compare(fused, prediction, target, weight, lambda_dssim=0.2):
    """Compare with the reference in float64, which makes its own weights from the float64 target."""
    loss = fused(prediction, target, weight, lambda_dssim)
    (gradient,) = torch.autograd.grad(loss, prediction)
    exact = prediction.detach().double().requires_grad_()
    spec = weight if isinstance(weight, WeightSpec) else "3dgs"
    stored = weight.double() if isinstance(weight, torch.Tensor) else None
    expected = legs_loss(exact, target.double(), spec, stored, lambda_dssim=lambda_dssim, channels_last=False)
    expected.backward()
    assert loss.dtype == torch.float32 and loss.shape == ()
    # float32 keeps 7 digits; SSIM's variances, differences of near-equal numbers, keep about 5.
    assert loss.item() == pytest.approx(expected.item(), rel=2e-5, abs=1e-6)
    # A pixel whose response is the least but for rounding has sqrt(rounding) of weight: hence the wider bound.
    bound = 2e-4 if isinstance(weight, WeightSpec) else 2e-5
    assert float((gradient.double() - exact.grad).norm() / exact.grad.norm()) < bound


def used(loss):
    """Say which code made a loss, from its graph."""
    names, nodes = set(), [loss.grad_fn]
    while nodes:
        node = nodes.pop()
        if node is not None:
            names.add(type(node).__name__)
            nodes += [parent for parent, _ in node.next_functions]
    return "fused" if "_FusedLossBackward" in names else "torch"


def by_signature(backend):
    """Return the loss of a backend with a map, a spec or None for the weight."""

    def loss(prediction, target, weight=None, lambda_dssim=0.2):
        weights = Weights(spec=weight) if isinstance(weight, WeightSpec) else Weights(map=weight)
        if weights.spec is not None and not backend.makes_weights_of(weights.spec):
            weights = weights.with_map(target)
        return backend.loss(terms_of(lambda_dssim), prediction, target, weights)

    return loss


def range_of(backend, target, spec):
    """Return the least response of each view and the span, by a backend."""
    return backend.prepare(L1, spec, target, target, False).response_range(target)


def fused(operation, prediction, target, weights=_NONE):
    """Return what a backend that is chosen for these images computes, None where torch has to."""
    terms = {"l1": L1, "ssim": SSIM}[operation]
    plan, prediction, target = backends.plan_of(terms, weights.spec, prediction, target, False)
    return backends.fused(plan, prediction, target, weights)
