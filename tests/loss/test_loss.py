"""The weighted L1 and the whole loss: 3DGS's own at beta 0 to the last bit, by hand, gradients, masks, layouts."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss import LegsError, LEGSLoss, WeightSpec, d_ssim, l1_loss, legs_loss, ssim, weight_map, weighted_l1
from tests.loss.test_ssim import formula_of_3dgs
from tests.strategies import images


def pair(*shape, dtype=torch.float32):
    return torch.rand(shape, dtype=dtype, requires_grad=True), torch.rand(shape, dtype=dtype)


class TestBaseline:
    @settings(max_examples=40, deadline=None)
    @given(images(max_side=40), st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]))
    def test_unweighted_l1_is_3dgs_own_to_the_last_bit(self, target, dtype):
        target = target.to(dtype)
        prediction = (target * 0.7 + 0.1).requires_grad_()
        expected = torch.abs(prediction - target).mean()
        result = weighted_l1(prediction, target, channels_last=False)
        assert torch.equal(result, expected)
        assert result.dtype == expected.dtype
        assert torch.equal(*[torch.autograd.grad(value, prediction)[0] for value in (result, expected)])

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("shape", [(3, 33, 47), (2, 3, 16, 16)])
    @pytest.mark.parametrize("lambda_dssim", [0.0, 0.2, 1.0])
    def test_beta_zero_is_3dgs_whole_loss_to_the_last_bit(self, dtype, shape, lambda_dssim):
        prediction, target = pair(*shape, dtype=dtype)
        l1 = torch.abs(prediction - target).mean()
        expected = (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - formula_of_3dgs(prediction, target))
        for spec in ("3dgs", WeightSpec(beta=0.0, curve="C5")):
            result = legs_loss(prediction, target, spec, lambda_dssim=lambda_dssim)
            assert torch.equal(result, expected)
            assert torch.equal(*[torch.autograd.grad(v, prediction, retain_graph=True)[0] for v in (result, expected)])

    def test_a_map_of_ones_changes_no_bit(self):
        prediction, target = pair(3, 33, 47)
        assert torch.equal(weighted_l1(prediction, target, torch.ones(1, 33, 47)), weighted_l1(prediction, target))


class TestValue:
    def test_by_hand(self):
        prediction = torch.tensor([[[0.0, 0.5]], [[1.0, 0.5]]])
        target = torch.tensor([[[0.5, 0.5]], [[0.0, 0.25]]])
        # Pixel 1: channels differ by 0.5 and 1: mean 0.75, weight 2. Pixel 2: 0 and 0.25: mean 0.125, weight 4.
        weight = torch.tensor([[2.0, 4.0]])
        assert float(weighted_l1(prediction, target, weight, channels_last=False)) == (2 * 0.75 + 4 * 0.125) / 2

    def test_the_whole_loss_is_its_two_terms(self):
        prediction, target = pair(3, 20, 20, dtype=torch.float64)
        weight = weight_map(target, "legs")
        expected = 0.7 * (weight * (prediction - target).abs()).mean() + 0.3 * d_ssim(prediction, target)
        torch.testing.assert_close(legs_loss(prediction, target, "legs", lambda_dssim=0.3), expected)

    def test_a_given_weight_is_used_in_place_of_the_specs(self):
        prediction, target = pair(3, 20, 20)
        weight = 1 + torch.rand(1, 20, 20)
        result = legs_loss(prediction, target, weight=weight, lambda_dssim=0.0)
        torch.testing.assert_close(result, (weight * (prediction - target).abs()).mean())

    @settings(max_examples=30, deadline=None)
    @given(images(), st.floats(0, 20), st.floats(0, 20))
    def test_it_grows_with_beta(self, target, first, second):
        prediction = 0.5 * target + 0.1
        low, high = sorted((first, second))
        losses = [
            legs_loss(prediction, target, WeightSpec(beta=beta), lambda_dssim=0.0, channels_last=False)
            for beta in (low, high)
        ]
        assert float(losses[0]) <= float(losses[1]) * (1 + 1e-12)

    def test_gradcheck(self):
        target = torch.rand(1, 7, 8, dtype=torch.float64)
        # Away from equality, where the absolute value has a kink.
        prediction = (target + 0.1 + 0.3 * torch.rand_like(target)).requires_grad_()
        mask = torch.rand(7, 8, dtype=torch.float64)
        for spec in ("3dgs", "eggs", "legs-l", "legs"):
            for options in ({}, {"mask": mask}, {"mask": mask, "renormalise": True}, {"padding": "reflect"}):
                assert torch.autograd.gradcheck(
                    lambda p, spec=spec, options=options: legs_loss(p, target, spec, **options), (prediction,)
                )

    def test_no_gradient_reaches_the_weight(self):
        prediction, target = torch.rand(2, 3, 8, 8).requires_grad_().unbind()
        target.retain_grad()
        legs_loss(prediction, target, lambda_dssim=0.0).backward()
        weight = weight_map(target.detach())
        torch.testing.assert_close(target.grad, weight * torch.sign(target - prediction).detach() / target.numel())


class TestMask:
    def test_it_zeroes_the_weight(self):
        prediction, target = pair(3, 6, 6)
        mask = torch.zeros(6, 6)
        mask[:3] = 1.0
        weight = 1 + torch.rand(1, 6, 6)
        inside = (weight * (prediction - target).abs())[:, :3]
        torch.testing.assert_close(weighted_l1(prediction, target, weight, mask), inside.sum() / (3 * 36))
        torch.testing.assert_close(
            weighted_l1(prediction, target, weight, mask, renormalise=True), inside.sum() / (3 * 18)
        )

    def test_bool_mask_and_empty_mask(self):
        prediction, target = pair(3, 6, 6)
        mask = torch.rand(1, 6, 6) > 0.5
        assert torch.equal(
            weighted_l1(prediction, target, mask=mask), weighted_l1(prediction, target, mask=mask.float())
        )
        empty = torch.zeros(1, 6, 6)
        assert float(weighted_l1(prediction, target, mask=empty)) == 0.0
        assert float(weighted_l1(prediction, target, mask=empty, renormalise=True)) == 0.0

    @pytest.mark.parametrize("function", [l1_loss, legs_loss, weighted_l1, LEGSLoss(), ssim])
    def test_a_mask_in_other_units_is_refused(self, function):
        prediction, target = torch.rand(3, 16, 16, requires_grad=True), torch.rand(3, 16, 16)
        white = torch.full((16, 16), 255, dtype=torch.uint8)
        with pytest.raises(LegsError, match=r"mask is of type torch.uint8: give bool, or floats in \[0, 1\]"):
            function(prediction, target, mask=white)
        for value, says in ((255.0, "from 255 to 255"), (-1.0, "from -1 to -1"), (math.nan, "from nan to nan")):
            with pytest.raises(LegsError, match=rf"mask has values {says}: give values in \[0, 1\]"):
                function(prediction, target, mask=torch.full((16, 16), value))

    def test_a_mask_that_was_rounded_is_one(self):
        prediction, target = torch.rand(3, 4, 5, requires_grad=True), torch.rand(3, 4, 5)
        rounded = weighted_l1(prediction, target, mask=torch.full((4, 5), 1.0 + 1e-6))
        torch.testing.assert_close(rounded, (prediction - target).abs().mean())

    @pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 2e6])
    def test_a_weight_that_is_none_is_refused(self, value):
        prediction, target = torch.rand(3, 16, 16, requires_grad=True), torch.rand(3, 16, 16)
        for function in (legs_loss, weighted_l1, LEGSLoss()):
            with pytest.raises(LegsError, match=r"weight has values from .*: give values in \[0, 1e\+06\]"):
                function(prediction, target, weight=torch.full((16, 16), value))


class TestLayouts:
    def test_batch_is_the_mean_of_its_views(self):
        prediction, target = pair(3, 3, 14, 15, dtype=torch.float64)
        single = torch.stack([legs_loss(prediction[i], target[i]) for i in range(3)]).mean()
        torch.testing.assert_close(legs_loss(prediction, target), single)

    def test_channels_last(self):
        prediction, target = pair(2, 3, 14, 15, dtype=torch.float64)
        mask = torch.rand(2, 14, 15, dtype=torch.float64)
        last = legs_loss(prediction.movedim(1, -1), target.movedim(1, -1), mask=mask)
        torch.testing.assert_close(last, legs_loss(prediction, target, mask=mask))

    @pytest.mark.parametrize("shape", [(1, 5, 6), (5, 6)])
    def test_shapes_of_a_map(self, shape):
        prediction, target = pair(3, 5, 6)
        weight = 1 + torch.rand(5, 6)
        expected = (weight * (prediction - target).abs()).mean()
        torch.testing.assert_close(weighted_l1(prediction, target, weight.reshape(shape)), expected)

    @pytest.mark.parametrize("shape", [(3, 1, 5, 6), (3, 5, 6)])
    def test_shapes_of_a_batchs_maps(self, shape):
        # Three views of three channels: a map [3, 5, 6] must not be taken for one of three channels.
        prediction, target = pair(3, 3, 5, 6)
        weight = 1 + torch.rand(3, 1, 5, 6)
        expected = (weight * (prediction - target).abs()).mean()
        torch.testing.assert_close(weighted_l1(prediction, target, weight.reshape(shape)), expected)

    def test_one_map_for_a_batch(self):
        prediction, target = pair(2, 3, 5, 6)
        weight = 1 + torch.rand(1, 5, 6)
        torch.testing.assert_close(
            weighted_l1(prediction, target, weight), (weight * (prediction - target).abs()).mean()
        )

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    def test_half_precision_and_autocast(self, dtype):
        prediction, target = pair(3, 16, 16)
        expected = legs_loss(prediction, target)
        half = legs_loss(prediction.to(dtype), target.to(dtype))
        assert half.dtype == torch.float32
        torch.testing.assert_close(half, expected, rtol=0.05, atol=0.05)
        half.backward()
        assert bool(torch.isfinite(prediction.grad).all())
        with torch.autocast("cpu", dtype=torch.bfloat16):
            assert torch.equal(legs_loss(prediction, target), expected)

    def test_a_float64_map_keeps_the_loss_in_float32(self):
        prediction, target = pair(3, 5, 6)
        assert weighted_l1(prediction, target, torch.ones(5, 6, dtype=torch.float64)).dtype == torch.float32

    def test_non_contiguous(self):
        prediction, target = pair(3, 24, 32)
        sliced = (prediction[:, ::2, ::2], target[:, ::2, ::2])
        torch.testing.assert_close(legs_loss(*sliced), legs_loss(*[t.contiguous() for t in sliced]))


class TestModule:
    def test_it_only_forwards(self):
        prediction, target = pair(2, 16, 17, 3)
        mask = torch.rand(2, 16, 17)
        module = LEGSLoss("eggs", 0.3, "reflect", True, True)
        expected = legs_loss(
            prediction,
            target,
            "eggs",
            mask=mask,
            lambda_dssim=0.3,
            padding="reflect",
            renormalise=True,
            channels_last=True,
        )
        assert torch.equal(module(prediction, target, mask=mask), expected)
        assert "sobel" in repr(module)
        assert not list(module.parameters())


class TestBadInput:
    def test_both_shapes_are_named(self):
        with pytest.raises(LegsError, match=r"prediction \[3, 8, 8\] and target \[3, 8, 9\]"):
            legs_loss(torch.rand(3, 8, 8), torch.rand(3, 8, 9))
        with pytest.raises(LegsError, match=r"weight \[8, 9\] does not fit images \[3, 8, 8\]"):
            weighted_l1(torch.rand(3, 8, 8), torch.rand(3, 8, 8), torch.ones(8, 9))
        with pytest.raises(LegsError, match=r"weight \[3, 8, 8\] does not fit"):
            weighted_l1(torch.rand(3, 8, 8), torch.rand(3, 8, 8), torch.ones(3, 8, 8))
        with pytest.raises(LegsError, match=r"mask \[2, 8, 8\]"):
            weighted_l1(torch.rand(3, 8, 8), torch.rand(3, 8, 8), mask=torch.ones(2, 8, 8))

    def test_what_is_no_image_is_named(self):
        with pytest.raises(LegsError, match=r"\[5, 3\] is a list of pixels"):
            legs_loss(torch.rand(5, 3), torch.rand(5, 3))
        with pytest.raises(LegsError, match="ndarray"):
            legs_loss(torch.rand(3, 4, 5), torch.rand(3, 4, 5).numpy())
        with pytest.raises(LegsError, match="uint8"):
            legs_loss(torch.rand(3, 4, 5), torch.zeros(3, 4, 5, dtype=torch.uint8))

    @pytest.mark.parametrize("value", [-0.1, 1.1, float("nan"), "0.2", None])
    def test_lambda_out_of_range(self, value):
        with pytest.raises(LegsError, match="lambda_dssim"):
            legs_loss(torch.rand(3, 4, 5), torch.rand(3, 4, 5), lambda_dssim=value)

    def test_a_broken_target(self):
        target = torch.rand(3, 4, 5)
        target[0, 0, 0] = float("nan")
        with pytest.raises(LegsError, match="NaN"):
            legs_loss(torch.rand(3, 4, 5), target)


@pytest.mark.parametrize(
    "loss", [l1_loss, weighted_l1, legs_loss, LEGSLoss()], ids=["l1_loss", "weighted_l1", "legs_loss", "LEGSLoss"]
)
@pytest.mark.parametrize("wrong", ["prediction", "target"])
def test_what_is_no_tensor_is_named(loss, wrong):
    images = {"prediction": torch.rand(3, 8, 8, requires_grad=True), "target": torch.rand(3, 8, 8)}
    images[wrong] = [[0.5]]
    with pytest.raises(LegsError, match=f"{wrong} must be a torch.Tensor, got list"):
        loss(**images)
