"""The Triton loss against the torch reference in float64: in Triton's interpreter, or on a GPU where there is one."""

from __future__ import annotations

import os
from dataclasses import replace

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported
pytest.importorskip("triton")

from legs_loss import LegsError, WeightSpec, legs_loss, weight_map
from legs_loss.kernels import backends
from legs_loss.kernels.triton_loss import fused_loss
from legs_loss.operators import operator_names
from legs_loss.spec import PRESETS
from tests.kernels_support import compare, images, used

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def on_device(shape):
    prediction, target = images(shape)
    return prediction.detach().to(DEVICE).requires_grad_(), target.to(DEVICE)


class TestFusedLoss:
    @pytest.mark.parametrize("weight", ["none", "map", "spec"])
    @pytest.mark.parametrize("shape", [(3, 1, 1), (1, 5, 7), (3, 44, 45), (2, 3, 30, 47), (4, 90, 3), (2, 1, 8, 9)])
    def test_value_and_gradient_equal_the_reference(self, shape, weight):
        prediction, target = on_device(shape)
        weights = {"none": None, "map": weight_map(target), "spec": PRESETS["legs"]}
        compare(fused_loss, prediction, target, weights[weight])

    @pytest.mark.parametrize("operator", operator_names())
    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_every_operator_and_norm(self, operator, p):
        compare(fused_loss, *on_device((2, 31, 45)), WeightSpec(operator=operator, p=p))

    @pytest.mark.parametrize("curve", ["C1", "C2", "C3", "C4", "C5"])
    def test_every_curve(self, curve):
        compare(fused_loss, *on_device((2, 1, 31, 45)), WeightSpec(curve=curve, beta=3.0))

    @pytest.mark.parametrize("changes", [{"percentile": 90.0}, {"normalise": "mean"}])
    def test_specs_that_need_a_map(self, changes):
        compare(fused_loss, *on_device((2, 3, 31, 25)), replace(PRESETS["legs"], **changes))

    @pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
    def test_any_share(self, share):
        compare(fused_loss, *on_device((3, 20, 30)), PRESETS["legs-l"], share)

    def test_one_map_for_a_batch(self):
        prediction, target = on_device((2, 3, 20, 30))
        weight = weight_map(target[0])
        expected = legs_loss(prediction.double(), target.double(), weight=weight.double())
        assert fused_loss(prediction, target, weight).item() == pytest.approx(expected.item(), rel=2e-5)

    def test_a_constant_target_has_weight_one(self):
        target = torch.full((3, 33, 47), 0.7, device=DEVICE)
        prediction = torch.rand(3, 33, 47, device=DEVICE)
        assert fused_loss(prediction, target, PRESETS["legs"]) == fused_loss(prediction, target)

    @pytest.mark.parametrize("dtypes", [(torch.float16, torch.float16), (torch.bfloat16, torch.float32)])
    def test_half_precision_is_computed_in_float32(self, dtypes):
        prediction, target = on_device((3, 20, 30))
        prediction, target = prediction.detach().to(dtypes[0]).requires_grad_(), target.to(dtypes[1])
        loss = fused_loss(prediction, target, PRESETS["legs"])
        # As a gradient scaler does it: unscaled, a step would be below float16's smallest number.
        (1024.0 * loss).backward()
        exact = prediction.detach().double().requires_grad_()
        expected = legs_loss(exact, target.double())
        (1024.0 * expected).backward()
        assert loss.dtype == torch.float32 and prediction.grad.dtype == dtypes[0]
        assert loss.item() == pytest.approx(expected.item(), rel=2e-5)
        error = (prediction.grad.double() - exact.grad).abs().max()
        assert float(error) <= torch.finfo(dtypes[0]).eps * float(exact.grad.abs().max())

    def test_non_contiguous_images_and_a_scaled_loss(self):
        target = torch.rand(20, 30, 3, device=DEVICE).movedim(-1, 0)
        prediction = torch.rand(20, 30, 3, device=DEVICE, requires_grad=True)
        (3.0 * fused_loss(prediction.movedim(-1, 0), target)).backward()
        other = prediction.detach().double().requires_grad_()
        (3.0 * legs_loss(other.movedim(-1, 0), target.double(), "3dgs")).backward()
        torch.testing.assert_close(prediction.grad.double(), other.grad, rtol=1e-4, atol=1e-8)

    def test_a_graph_that_is_retained_gives_its_gradient_again(self):
        prediction, target = on_device((3, 20, 30))
        loss = fused_loss(prediction, target, PRESETS["legs"])
        first = torch.autograd.grad(2.0 * loss, prediction, retain_graph=True)[0].clone()
        assert torch.equal(torch.autograd.grad(2.0 * loss, prediction)[0], first)

    def test_without_a_gradient_it_is_the_same_number(self):
        prediction, target = on_device((3, 40, 30))
        with torch.no_grad():
            plain = fused_loss(prediction, target, PRESETS["legs"])
        assert not plain.requires_grad
        assert plain == fused_loss(prediction, target, PRESETS["legs"])

    def test_a_nan_in_the_target_is_never_hidden(self):
        prediction, target = on_device((3, 20, 30))
        target[1, 3, 29] = float("nan")
        if DEVICE.type == "cpu":
            with pytest.raises(LegsError, match="NaN"):
                fused_loss(prediction, target, PRESETS["legs"])
        else:
            assert torch.isnan(fused_loss(prediction, target, PRESETS["legs"]))


class TestSelection:
    def test_it_can_be_forced(self, monkeypatch):
        monkeypatch.setattr(backends, "_findings", {})
        monkeypatch.setenv("LEGS_BACKEND", "triton")
        prediction, target = on_device((3, 20, 30))
        mask = torch.rand(20, 30, device=DEVICE) > 0.5
        loss = legs_loss(prediction, target, mask=mask, renormalise=True)
        assert backends.backend_for(DEVICE) == "triton" and used(loss) == "fused"
        expected = legs_loss(prediction.double(), target.double(), mask=mask, renormalise=True)
        assert loss.item() == pytest.approx(expected.item(), rel=2e-5)
