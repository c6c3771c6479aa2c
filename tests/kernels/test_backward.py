"""Backward of every backend: once from the forward pass, again only from tensors that nobody changed, as in torch."""

from __future__ import annotations

import pytest
import torch

from legs_loss import legs_loss
from legs_loss.kernels.contract import L1, SSIM, terms_of
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.kernels.on_device import DEVICE, MISSING, new_backend
from tests.kernels.support import images

LEGS = PRESETS["legs"]


def backend_named(name):
    if name == "cuda":
        if MISSING is not None:
            pytest.skip(MISSING)
        return new_backend()
    pytest.importorskip("numba")
    from legs_loss.kernels.numba_loss import BACKEND

    return BACKEND


@pytest.fixture(params=["numba", "cuda"], scope="module")
def backend(request):
    return backend_named(request.param)


@pytest.fixture
def given(backend):
    """A prediction, a target and a map on the backend's device."""
    device = DEVICE if backend.name == "cuda" else torch.device("cpu")
    prediction, target = (image.detach().to(device) for image in images((3, 24, 40)))
    map_ = 1.0 + torch.rand(1, 24, 40, device=device)
    return {"prediction": prediction.requires_grad_(), "target": target, "map": map_}


OPERATIONS = {
    "loss": lambda backend, x, y, weights: backend.loss(terms_of(0.2), x, y, weights),
    "l1": lambda backend, x, y, weights: backend.loss(L1, x, y, weights),
    "ssim": lambda backend, x, y, _: backend.loss(SSIM, x, y),
}


def loss_of(backend, operation, given):
    return OPERATIONS[operation](backend, given["prediction"], given["target"], Weights(map=given["map"]))


def torchs(given):
    """The same loss by torch, whose behaviour is the model."""
    image = given["prediction"].double()
    return legs_loss(image, given["target"].double(), weight=given["map"].double())


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_retained_graph_gives_the_same_bits_again(backend, given, operation):
    loss = loss_of(backend, operation, given)
    first = torch.autograd.grad(loss, given["prediction"], retain_graph=True)[0].clone()
    for _ in range(2):
        assert torch.equal(torch.autograd.grad(loss, given["prediction"], retain_graph=True)[0], first)


@pytest.mark.parametrize(
    ("operation", "changed"),
    [("loss", "prediction"), ("loss", "target"), ("loss", "map"), ("l1", "prediction"), ("l1", "target"),
     ("ssim", "prediction"), ("ssim", "target")],
)  # fmt: skip
def test_what_was_changed_in_place_is_not_differentiated_again(backend, given, operation, changed):
    loss = loss_of(backend, operation, given)
    torch.autograd.grad(loss, given["prediction"], retain_graph=True)
    with torch.no_grad():
        given[changed].mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        torch.autograd.grad(loss, given["prediction"], retain_graph=True)


@pytest.mark.parametrize("operation", OPERATIONS)
def test_a_graph_that_is_not_retained_is_differentiated_once(backend, given, operation):
    for loss in (loss_of(backend, operation, given), torchs(given)):
        torch.autograd.grad(loss, given["prediction"])
        with pytest.raises(RuntimeError, match="backward through the graph a second time"):
            torch.autograd.grad(loss, given["prediction"])


@pytest.mark.parametrize("operation", OPERATIONS)
def test_the_first_gradient_is_of_the_values_that_the_loss_is_of(backend, given, operation):
    """A script that clips its rendering for a log before backward trains as before: that gradient exists already."""
    (expected,) = torch.autograd.grad(loss_of(backend, operation, given), given["prediction"])
    loss = loss_of(backend, operation, given)
    with torch.no_grad():
        given["prediction"].clamp_(0.2, 0.5)
        given["target"].zero_()
    assert torch.equal(torch.autograd.grad(loss, given["prediction"])[0], expected)


@pytest.mark.parametrize("grey", [False, True])
def test_a_target_of_inference_mode(backend, given, grey):
    with torch.inference_mode():
        target = given["target"] * 1.0
        target = target[:1].expand(3, -1, -1) if grey else target  # whose copy has other strides
    weights = Weights(spec=LEGS)
    loss = backend.loss(terms_of(0.2), given["prediction"], target, weights)
    (gradient,) = torch.autograd.grad(loss, given["prediction"], retain_graph=True)
    assert torch.equal(gradient.clone(), torch.autograd.grad(loss, given["prediction"])[0])
