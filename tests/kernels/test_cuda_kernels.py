"""The CUDA kernels' own source, behind their own Python layer, against torch in float64.

On the CPU, compiled with g++; with LEGS_TEST_DEVICE=cuda on a GPU, compiled by NVRTC.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss import (
    LegsError,
    WeightSpec,
    configure,
    l1_loss,
    legs_loss,
    register_curve,
    ssim,
    weight_map,
    weighted_l1,
)
from legs_loss.curves import FORMULAS
from legs_loss.kernels import backends
from legs_loss.kernels.available import BACKENDS, Availability
from legs_loss.kernels.codes import STENCILS
from legs_loss.kernels.contract import L1, SSIM, terms_of
from legs_loss.kernels.trial import difference_from_torch
from legs_loss.responses import response
from legs_loss.runtime import state
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.cuda_emulation import COMPILER, TRIED
from tests.kernels.on_device import DEVICE, MISSING, new_backend, new_driver
from tests.kernels.support import by_signature, compare, fused, images, range_of, used
from tests.support import legs_environment

pytestmark = pytest.mark.skipif(MISSING is not None, reason=str(MISSING))

LEGS = PRESETS["legs"]
SHAPES = [(3, 1, 1), (1, 5, 7), (3, 44, 45), (2, 3, 30, 47), (4, 90, 3), (3, 137, 251), (6, 300, 109), (2, 1, 8, 300)]


@pytest.fixture(scope="module")
def backend():
    return new_backend()


@pytest.fixture
def chosen(monkeypatch):
    """Make the backend under test the one for images on the device, and return it and its driver."""
    driver = new_driver()
    backend = new_backend(driver)
    found = Availability(backend, "", TRIED)
    device = torch.empty(0, device=DEVICE).device
    monkeypatch.setattr(BACKENDS, "known", {DEVICE.type: ("cuda", "no module")})
    monkeypatch.setattr(BACKENDS, "found", {device: found})
    monkeypatch.delenv("LEGS_BACKEND", raising=False)
    return found.backend, driver


@pytest.fixture(autouse=True)
def on_device():
    """Make new tensors on the device."""
    if DEVICE.type == "cpu":
        yield
        return
    with DEVICE:
        yield


@pytest.fixture(autouse=True)
def poisoned():
    """Fill torch's new memory with NaN, which shows values that are read before they are written, or never written."""
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(False)


def compare_l1(backend, prediction, target, weights, **reference):
    loss = backend.loss(L1, prediction, target, weights)
    (gradient,) = torch.autograd.grad(loss, prediction)
    exact = prediction.detach().double().requires_grad_()
    if weights.spec is not None:
        reference["weight"] = weight_map(target.double(), weights.spec, False)
    expected = weighted_l1(exact, target.double(), channels_last=False, **reference)
    (exact_gradient,) = torch.autograd.grad(expected, exact)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-7)
    assert float((gradient.double() - exact_gradient).norm() / exact_gradient.norm()) < 2e-4


class TestLoss:
    @pytest.mark.parametrize("weight", ["none", "map", "spec"])
    @pytest.mark.parametrize("shape", SHAPES)
    def test_value_and_gradient_equal_the_reference(self, backend, shape, weight):
        prediction, target = images(shape)
        weights = {"none": None, "map": weight_map(target, channels_last=False), "spec": LEGS}
        compare(by_signature(backend), prediction, target, weights[weight])

    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    @pytest.mark.parametrize("operator", STENCILS)
    def test_every_operator_and_norm(self, backend, operator, p):
        compare(by_signature(backend), *images((3, 31, 45)), WeightSpec(operator=operator, p=p))

    @pytest.mark.parametrize("curve", FORMULAS)
    def test_every_curve(self, backend, curve):
        compare(by_signature(backend), *images((2, 3, 31, 145)), WeightSpec(curve=curve, beta=3.0))

    @settings(max_examples=25, deadline=None)
    @given(st.integers(1, 300), st.integers(1, 300), st.integers(1, 4), st.floats(0.05, 1), st.integers(1, 200))
    def test_any_size_share_and_number_of_multiprocessors(self, height, width, channels, share, multiprocessors):
        prediction, target = images((channels, height, width))
        backend = new_backend(new_driver(multiprocessors))
        compare(by_signature(backend), prediction, target, weight_map(target, channels_last=False), share)

    @pytest.mark.parametrize("dtypes", [(torch.float16,) * 2, (torch.bfloat16,) * 2, (torch.float16, torch.float32)])
    def test_half_precision_is_computed_in_float32(self, backend, dtypes):
        prediction, target = images((3, 40, 130))
        prediction, target = prediction.detach().to(dtypes[0]).requires_grad_(), target.to(dtypes[1])
        for weights in (Weights(spec=LEGS), Weights(map=torch.rand(1, 40, 130))):
            loss = backend.loss(terms_of(0.2), prediction, target, weights)
            # As a gradient scaler does it: unscaled, a step would be below float16's smallest number.
            (gradient,) = torch.autograd.grad(1024.0 * loss, prediction)
            exact = prediction.detach().double().requires_grad_()
            expected = legs_loss(exact, target.double(), weight=None if weights.map is None else weights.map.double())
            (exact_gradient,) = torch.autograd.grad(1024.0 * expected, exact)
            assert loss.dtype == torch.float32 and gradient.dtype == dtypes[0]
            assert loss.item() == pytest.approx(expected.item(), rel=2e-5)
            error = (gradient.double() - exact_gradient).abs().max()
            assert float(error) <= torch.finfo(dtypes[0]).eps * float(exact_gradient.abs().max())

    def test_a_flat_target_has_weight_one(self, backend):
        target, prediction = torch.full((3, 33, 147), 0.7), torch.rand(3, 33, 147)
        for operator in STENCILS:
            spec = WeightSpec(operator=operator, eps=1e-30)
            weighted = backend.loss(terms_of(0.2), prediction, target, Weights(spec=spec))
            assert torch.equal(weighted, backend.loss(terms_of(0.2), prediction, target, Weights()))

    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    @pytest.mark.parametrize("operator", STENCILS)
    def test_a_nan_in_the_target_is_never_hidden(self, backend, operator, p):
        prediction, target = images((2, 3, 20, 30))
        target[1, 1, 3, 29] = float("nan")
        spec = WeightSpec(operator=operator, p=p)
        found = range_of(backend, target, spec)
        assert torch.isfinite(found[0]).all() and torch.isnan(found[1]).all()
        loss = backend.loss(L1, prediction, target, Weights(spec=spec))
        loss.backward()
        assert torch.isnan(loss) and torch.isfinite(prediction.grad[0]).all()
        assert torch.isnan(backend.loss(terms_of(0.2), prediction, target, Weights(spec=spec)))

    def test_it_repeats_bit_for_bit_in_any_order_of_the_threads(self):
        prediction, target = images((2, 3, 61, 133))
        results = []
        for backwards in (False, False, True):
            driver = new_driver()
            driver.backwards = backwards
            backend = new_backend(driver)
            for weights in (Weights(spec=LEGS), Weights(spec=WeightSpec(operator="sobel", p=float("inf")))):
                for loss in (
                    backend.loss(terms_of(0.2), prediction, target, weights),
                    backend.loss(L1, prediction, target, weights),
                    backend.loss(SSIM, prediction, target),
                ):
                    results.append((loss, *torch.autograd.grad(loss, prediction)))
        third = len(results) // 3
        for first, second, third_ in zip(results[:third], results[third : 2 * third], results[2 * third :]):
            assert all(torch.equal(a, b) and torch.equal(a, c) for a, b, c in zip(first, second, third_))

    def test_a_range_that_is_kept_gives_the_same_bits(self, backend):
        prediction, target = images((2, 3, 40, 50))
        kept = torch.cat([range_of(backend, view, LEGS) for view in target])
        for operation in (partial(backend.loss, L1), partial(backend.loss, terms_of(0.2))):
            made = operation(prediction, target, Weights(spec=LEGS))
            assert torch.equal(made, operation(prediction, target, Weights(spec=LEGS, range=kept)))

    def test_a_range_for_other_images_is_refused(self, backend):
        with pytest.raises(ValueError, match=r"a range \[1, 2\] does not fit images \[2, 3, 8, 8\]"):
            backend.loss(L1, *images((2, 3, 8, 8)), Weights(spec=LEGS, range=torch.zeros(1, 2)))


class TestRounding:
    """The distance of float32 from float64; reciprocals and roots of the emulation are off by a unit in the last place.

    Of noise the value keeps 1e-7: the result's own rounding is 6e-8. With weights from the target 2e-7, since the span
    of responses is one float32 that all weights share. Of smooth images no float32 can: variances and responses are
    differences of near-equal numbers, so an error of 1e-7 in a mean is one of 1e-4 beside SSIM's second constant.
    There torch's own float32 is the measure. With exact reciprocals and roots the errors are the same.
    """

    @staticmethod
    def errors(backend, target):
        """Yield of map, spec and SSIM how far value and gradient are off, and torch's own in float32."""
        torch.manual_seed(3)
        prediction = (0.8 * target + 0.1 * torch.rand(target.shape)).requires_grad_()
        map_ = weight_map(target, LEGS, False)

        def whole(images, exact):
            return legs_loss(images, exact, weight=map_.to(images.dtype), padding="zeros", channels_last=False)

        for own, reference in (
            (lambda: backend.loss(terms_of(0.2), prediction, target, Weights(map=map_)), whole),
            (
                lambda: backend.loss(terms_of(0.2), prediction, target, Weights(LEGS)),
                lambda x, y: legs_loss(x, y, LEGS),
            ),
            (lambda: backend.loss(SSIM, prediction, target), ssim),
        ):
            exact = prediction.detach().double().requires_grad_()
            expected = reference(exact, target.double())
            (gradient,) = torch.autograd.grad(expected, exact)
            found = []
            for loss in (own(), reference(prediction, target)):
                (slope,) = torch.autograd.grad(loss, prediction)
                found.append(abs(loss.item() / expected.item() - 1.0))
                found.append(float((slope.double() - gradient).norm() / gradient.norm()))
            yield found

    @pytest.mark.parametrize("shape", [(3, 44, 45), (3, 137, 251), (2, 3, 200, 300)])
    def test_of_noise_the_value_keeps_seven_digits(self, backend, monkeypatch, shape):
        monkeypatch.setenv("LEGS_BACKEND", "torch")
        torch.manual_seed(2)
        bounds = ((1e-7, 1e-7), (2e-7, 2e-7), (1e-7, 1e-6))
        for (value, gradient, _, _), most in zip(self.errors(backend, torch.rand(shape)), bounds):
            assert value <= most[0] and gradient <= most[1]

    def test_of_smooth_images_it_is_as_near_as_torch(self, backend, monkeypatch):
        monkeypatch.setenv("LEGS_BACKEND", "torch")
        rows, columns = torch.arange(137.0).reshape(-1, 1), torch.arange(251.0)
        target = 0.5 + 0.4 * torch.sin(torch.arange(1.0, 4.0).reshape(3, 1, 1) * (0.03 * rows + 0.02 * columns))
        for (value, gradient, _, of_torch), most in zip(self.errors(backend, target), (2e-6, 1e-5, 2e-6)):
            assert value <= most and gradient <= of_torch


class TestRange:
    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    @pytest.mark.parametrize("operator", STENCILS)
    def test_it_is_the_responses(self, backend, operator, p):
        for shape in ((3, 1, 1), (2, 3, 1, 40), (3, 5, 2), (2, 4, 33, 90), (3, 200, 210)):
            target = torch.rand(shape)
            found = range_of(backend, target, WeightSpec(operator=operator, p=p))
            exact = response(target.double(), operator, p, False).reshape(found.shape[0], -1)
            low, high = exact.min(1).values, exact.max(1).values
            torch.testing.assert_close(found.double(), torch.stack([low, high - low], 1), rtol=1e-6, atol=1e-6)


class TestWeightedL1:
    @pytest.mark.parametrize("shape", SHAPES)
    def test_value_and_gradient_equal_the_reference(self, backend, shape):
        prediction, target = images(shape)
        weight = weight_map(target, channels_last=False)
        compare_l1(backend, prediction, target, Weights())
        compare_l1(backend, prediction, target, Weights(map=weight), weight=weight)
        compare_l1(backend, prediction, target, Weights(spec=LEGS))

    @pytest.mark.parametrize("renormalise", [False, True])
    def test_masks(self, backend, renormalise):
        prediction, target = images((2, 3, 40, 50))
        for mask in (torch.rand(40, 50) > 0.4, torch.rand(2, 1, 40, 50), torch.zeros(1, 40, 50)):
            weights = Weights(spec=LEGS).masked(mask if mask.dim() > 2 else mask[None], renormalise)
            loss = weights.of_what_counts(backend.loss(L1, prediction, target, weights))
            expected = weighted_l1(prediction, target, weight_map(target), mask, renormalise)
            assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
            gradients = [torch.autograd.grad(value, prediction)[0] for value in (loss, expected)]
            torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-9)

    def test_where_both_are_equal_the_gradient_is_zero(self, backend):
        target = torch.rand(3, 20, 20)
        prediction = target.clone().requires_grad_()
        loss = backend.loss(L1, prediction, target, Weights(spec=LEGS))
        loss.backward()
        assert loss.item() == 0.0 and not prediction.grad.any()


class TestSsim:
    @pytest.mark.parametrize("shape", SHAPES)
    def test_value_and_gradient_equal_the_reference(self, backend, shape):
        prediction, target = images(shape)
        found = backend.loss(SSIM, prediction, target)
        exact = prediction.detach().double().requires_grad_()
        expected = ssim(exact, target.double(), channels_last=False)
        (gradient,), (reference,) = torch.autograd.grad(found, prediction), torch.autograd.grad(expected, exact)
        assert found.item() == pytest.approx(expected.item(), rel=1e-5)
        assert float((gradient.double() - reference).norm() / reference.norm()) < 2e-5

    def test_equal_images_have_one(self, backend):
        image = torch.rand(3, 20, 300)
        assert backend.loss(SSIM, image, image).item() == pytest.approx(1.0, abs=1e-6)


class TestAutograd:
    def test_channels_last_and_pieces_of_images_are_read_where_they_are(self, backend):
        # Around the pieces is NaN: a pixel too far would show.
        for make in (
            lambda: torch.rand(2, 40, 150, 3).movedim(-1, 1),
            lambda: torch.full((2, 5, 60, 170), float("nan"))[:, 1:4, 7:47, 9:159].copy_(torch.rand(2, 3, 40, 150)),
            lambda: torch.rand(1, 3, 40, 150).expand(2, 3, 40, 150),
        ):
            prediction, target = make().requires_grad_(), make()
            compare(by_signature(backend), prediction, target, LEGS)
            compare_l1(backend, prediction, target, Weights(spec=LEGS))

    def test_what_arrives_in_backward_is_a_factor(self, backend):
        prediction, target = images((3, 20, 30))
        for factor in (1.0, 3.0, 0.0):
            loss = backend.loss(terms_of(0.2), prediction, target, Weights(spec=LEGS))
            (once,) = torch.autograd.grad(loss, prediction, retain_graph=True)
            once = once.clone()
            (scaled,) = torch.autograd.grad(factor * loss, prediction)
            assert torch.equal(scaled, factor * once)

    def test_without_a_gradient_it_is_the_same_number(self, backend):
        prediction, target = images((3, 40, 300))
        for operation in (
            lambda: backend.loss(terms_of(0.2), prediction, target, Weights(spec=LEGS)),
            lambda: backend.loss(L1, prediction, target, Weights(spec=LEGS)),
            lambda: backend.loss(SSIM, prediction, target),
        ):
            with torch.no_grad():
                plain = operation()
            assert not plain.requires_grad
            assert plain.item() == pytest.approx(operation().item(), rel=1e-6)

    def test_second_derivatives_are_refused(self, backend):
        prediction, target = images((3, 8, 8))
        (gradient,) = torch.autograd.grad(backend.loss(SSIM, prediction, target), prediction, create_graph=True)
        with pytest.raises(LegsError, match="no second derivative: set LEGS_BACKEND=torch"):
            gradient.sum().backward()


class TestSelection:
    @pytest.mark.parametrize("operation", ["l1", "ssim", "loss"])
    def test_its_trial_agrees_with_torch(self, backend, operation):
        assert difference_from_torch(backend, DEVICE, operation, LEGS) is None

    @pytest.mark.parametrize("channels_last", [False, True])
    def test_the_front_ends_mean_the_same_as_torch(self, chosen, channels_last):
        prediction, target = images((2, 3, 24, 31))
        mask, weight = torch.rand(24, 31) > 0.4, 1.0 + torch.rand(2, 24, 31)
        if channels_last:
            prediction, target = prediction.detach().movedim(1, -1).requires_grad_(), target.movedim(1, -1)
        for options in ({}, {"mask": mask}, {"mask": mask, "renormalise": True}, {"weight": weight, "mask": mask}):
            loss = legs_loss(prediction, target, channels_last=channels_last, **options)
            assert used(loss) == "fused"
            expected = legs_loss(prediction.double(), target.double(), channels_last=channels_last, **options)
            assert loss.item() == pytest.approx(expected.item(), rel=2e-5)
            gradients = [torch.autograd.grad(value, prediction)[0] for value in (loss, expected)]
            torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-8)
        if channels_last:  # as the front ends hand them over: views of the same memory
            prediction, target = prediction.movedim(-1, 1), target.movedim(-1, 1)
        weights = Weights(spec=LEGS, range=backends.fused_range(target, LEGS))
        found = fused("l1", prediction, target, weights)
        expected = weighted_l1(prediction, target, weight_map(target, LEGS))
        assert found.item() == pytest.approx(expected.item(), rel=1e-5)
        found = fused("ssim", prediction, target)
        with torch.no_grad():  # then it is torch's
            expected = ssim(prediction, target)
        assert found.item() == pytest.approx(expected.item(), rel=1e-5)

    @pytest.mark.parametrize("channels_last", [False, True])
    def test_the_drop_ins_are_fused(self, chosen, channels_last):
        state.reset()
        configure("legs")
        driver = chosen[1]
        prediction, target = images((2, 3, 24, 31))
        if channels_last:
            prediction, target = prediction.detach().movedim(1, -1).requires_grad_(), target.movedim(1, -1)
        weight = weight_map(target, LEGS, channels_last)
        loss = l1_loss(prediction, target, channels_last=channels_last)
        expected = weighted_l1(prediction, target, weight, channels_last=channels_last)
        assert used(loss) == "fused" and "legs_range" in dict(driver.launches)
        assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
        gradients = [torch.autograd.grad(value, prediction)[0] for value in (loss, expected)]
        torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-8)
        assert used(ssim(prediction, target, channels_last=channels_last)) == "fused"
        state.reset()

    @pytest.mark.parametrize("changes", [{"percentile": 90.0}, {"normalise": "mean"}, {"curve": "test-cube"}])
    def test_specs_that_it_does_not_know_get_torchs_map(self, chosen, changes):
        if "curve" in changes:
            with contextlib.suppress(LegsError):  # registered by an earlier run of this test
                register_curve("test-cube", lambda x: x * x * x)
        _, driver = chosen
        prediction, target = images((3, 31, 25))
        spec = replace(LEGS, **changes)
        assert backends.fused_range(target, spec) is None
        loss = legs_loss(prediction, target, spec)
        assert used(loss) == "fused" and "legs_range" not in dict(driver.launches)
        assert loss.item() == pytest.approx(legs_loss(prediction.double(), target.double(), spec).item(), rel=2e-5)

    @pytest.mark.parametrize("which", ["prediction", "target", "weight"])
    def test_memory_that_is_to_be_read_negated_is_torchs(self, chosen, which):
        given = dict(zip(("prediction", "target", "weight"), (*images((3, 20, 30)), 1.0 + torch.rand(20, 30))))
        given[which] = torch._neg_view(-given[which].detach()).requires_grad_(which == "prediction")
        given["prediction"].requires_grad_()
        for weight in (None, given["weight"]) if which != "weight" else (given["weight"],):
            found = legs_loss(given["prediction"], given["target"], weight=weight)
            exact = [None if one is None else one.double() for one in (given["prediction"], given["target"], weight)]
            assert used(found) == "torch"
            assert found.item() == pytest.approx(legs_loss(*exact[:2], weight=exact[2]).item(), rel=2e-5)

    def test_what_it_does_not_take_is_torchs(self, chosen):
        prediction, target = images((3, 20, 30))
        assert used(legs_loss(prediction.double(), target.double())) == "torch"
        assert used(legs_loss(prediction, target, padding="reflect")) == "torch"
        assert used(legs_loss(prediction, target.clone().requires_grad_())) == "torch"
        assert used(ssim(prediction, target, padding="valid")) == "torch"


@pytest.mark.slow
@pytest.mark.skipif(DEVICE.type != "cpu", reason="the sanitizers are g++'s")
def test_no_access_is_out_of_bounds():
    """Run every kernel with the address and undefined behaviour sanitizers, which end the process at a fault."""
    found = subprocess.run([str(COMPILER), "-print-file-name=libasan.so"], capture_output=True, text=True)
    library = found.stdout.strip()
    if "/" not in library:
        pytest.skip("g++ has no address sanitizer here")
    code = (
        "import torch\n"
        "from legs_loss import WeightSpec\n"
        "from legs_loss.kernels.contract import L1, SSIM, terms_of\n"
        "from legs_loss.weights import Weights\n"
        "from tests.cuda_emulation import emulated\n"
        "backend = emulated(flags=['-fsanitize=address,undefined', '-fno-sanitize-recover=all', '-O1'])\n"
        "for shape in ((3, 1, 1), (1, 2, 7), (2, 3, 37, 113), (3, 130, 5)):\n"
        "    for dtype in (torch.float32, torch.float16):\n"
        "        x, y = torch.rand(shape).to(dtype).requires_grad_(), torch.rand(shape).to(dtype)\n"
        "        mask = torch.rand(shape[-2:])\n"
        "        for spec in (WeightSpec(curve='C5'), WeightSpec(operator='scharr', p=float('inf'))):\n"
        "            weights = Weights(spec=spec, map=mask)\n"
        "            backend.loss(terms_of(0.2), x, y, weights).backward()\n"
        "            backend.loss(L1, x, y, weights).backward()\n"
        "        backend.loss(SSIM, x, y).backward()\n"
        "        with torch.no_grad():\n"
        "            backend.loss(terms_of(0.2), x, y, Weights(map=mask))\n"
        "            backend.loss(SSIM, x, y)\n"
        "print('done')\n"
    )
    environment = {**legs_environment(), "LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0"}
    environment["PYTHONPATH"] += ":" + str(Path(__file__).resolve().parents[2])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert done.stdout == "done\n", done.stderr[-3000:]
