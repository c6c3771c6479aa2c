"""The drop-in l1_loss and its backends: the fused cases, and a step's demands on a device."""

from __future__ import annotations

import pytest
import torch

from legs_loss import LegsError, WeightSpec, configure, l1_loss, weight_map
from legs_loss.runtime import counts, state
from tests.runtime.support import pair, plain, weighted


class TestBackends:
    @pytest.fixture(autouse=True)
    def needs_numba(self):
        pytest.importorskip("numba")

    def test_the_mean_is_one_fused_pass(self):
        prediction, target = pair(3, 30, 40)
        mask = torch.rand(30, 40)
        for options, expected in (({}, weighted(prediction, target)), ({"mask": mask}, None)):
            loss = l1_loss(prediction, target, **options)
            assert type(loss.grad_fn).__name__ == "_FusedLossBackward"
            if expected is None:
                expected = (mask * weight_map(target) * torch.abs(prediction - target)).mean()
            torch.testing.assert_close(loss, expected)
            gradients = [torch.autograd.grad(one, prediction)[0] for one in (loss, expected)]
            torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-9)
        assert state.current_run().memo.bytes == 0

    @pytest.mark.parametrize("options", [{"reduction": "none"}, {"own": plain}])
    def test_what_needs_the_map_gets_it(self, options):
        prediction, target = pair(3, 30, 40)
        loss = l1_loss(prediction, target, **options)
        torch.testing.assert_close(loss.mean(), weighted(prediction, target))
        l1_loss(prediction, target)
        assert (counts().computed, counts().remembered) == (2, 0)

    @pytest.mark.parametrize("spec", [WeightSpec(curve="C5"), WeightSpec(percentile=90.0)])
    def test_specs_that_need_a_map(self, spec):
        configure(spec)
        prediction, target = pair(3, 30, 40)
        expected = weight_map(target, spec)
        for _ in range(2):
            loss = l1_loss(prediction, target)
            torch.testing.assert_close(loss, (expected * torch.abs(prediction - target)).mean())
        assert (counts().computed, counts().remembered) == (1, 1)


class TestOtherDevices:
    """On the meta device reading a value is an error, so code that works there never waits for a device."""

    @pytest.mark.parametrize("spec", ["legs", "eggs", WeightSpec(normalise="mean"), WeightSpec(percentile=99.0)])
    def test_a_step_reads_nothing_from_the_device(self, spec):
        if not isinstance(spec, str) and spec.percentile < 100 and not hasattr(torch, "compile"):
            pytest.skip("torch 1 has no kthvalue on this device")
        configure(spec)
        prediction = torch.empty(3, 16, 16, device="meta", requires_grad=True)
        target = torch.empty(4, 16, 16, device="meta")[:3]
        for _ in range(2):
            loss = l1_loss(prediction, target, view="a", mask=torch.empty(16, 16, device="meta"))
            loss.backward()
        assert loss.device.type == "meta"
        with pytest.raises((RuntimeError, NotImplementedError)):
            loss.item()

    def test_a_target_that_stays_is_computed_once(self):
        stored = torch.empty(4, 16, 16, device="meta")
        prediction = torch.empty(3, 16, 16, device="meta", requires_grad=True)
        for _ in range(3):
            l1_loss(prediction, stored[:3])
        assert (counts().computed, counts().remembered) == (1, 2)
        stored.add_(1)
        l1_loss(prediction, stored[:3])
        assert counts().computed == 2

    def test_devices_that_differ_are_named(self):
        with pytest.raises(LegsError, match="prediction is on cpu and target on meta"):
            l1_loss(torch.rand(3, 8, 8, requires_grad=True), torch.empty(3, 8, 8, device="meta"))
