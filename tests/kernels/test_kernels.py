"""The fused losses against the torch reference in float64, and the choice between them."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from legs_loss import LegsError, LEGSLoss, WeightSpec, l1_loss, legs_loss, ssim, weight_map
from legs_loss.curves import FORMULAS
from legs_loss.kernels.available import BACKENDS
from legs_loss.kernels.contract import L1, SSIM, terms_of
from legs_loss.operators import OPERATORS, Operator
from legs_loss.precompute import normalised_map
from legs_loss.responses import response
from legs_loss.scenes.images import image_tensor
from legs_loss.spec import PRESETS
from legs_loss.weights import Weights
from tests.kernels.support import by_signature, compare, images, range_of, used
from tests.preloaded import run
from tests.support import legs_environment

pytest.importorskip("numba")

from legs_loss.kernels import numba_loss
from legs_loss.kernels.codes import STENCILS
from legs_loss.kernels.numba_response import extremes, operator_of
from legs_loss.precompute.compiled import photograph_response

fused_loss = by_signature(numba_loss.BACKEND)
COMPILED = [*STENCILS]

OF_THE_FIRST_STEP = "legs-loss: L1 weighted: laplacian, C3, beta 10, by legs_loss\n"  # if no test came before
SHAPES = [(3, 1, 1), (1, 5, 7), (3, 40, 300), (2, 3, 30, 17), (3, 150, 530), (4, 11, 257), (2, 1, 8, 9), (3, 129, 8)]


class TestFusedLoss:
    @pytest.mark.parametrize("weight", ["none", "map", "spec"])
    @pytest.mark.parametrize("shape", SHAPES)
    def test_value_and_gradient_equal_the_reference(self, shape, weight):
        prediction, target = images(shape)
        compare(
            fused_loss,
            prediction,
            target,
            {"none": None, "map": weight_map(target, channels_last=False), "spec": PRESETS["legs"]}[weight],
        )

    @pytest.mark.parametrize("terms", [L1, SSIM, terms_of(0.2)])
    def test_a_map_of_another_size_is_never_read(self, terms):
        prediction, target = images((2, 3, 30, 17))
        for size in ((1, 4, 4), (3, 1, 30, 17), (1, 30, 18)):
            with pytest.raises(LegsError, match=r"does not fit images \[2, 3, 30, 17\]"):
                numba_loss.BACKEND.loss(terms, prediction.requires_grad_(), target, Weights(map=torch.ones(size)))

    @pytest.mark.parametrize("operator", COMPILED)
    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_every_operator_and_norm(self, operator, p):
        compare(fused_loss, *images((3, 31, 45)), WeightSpec(operator=operator, p=p))

    @pytest.mark.parametrize("curve", FORMULAS)
    def test_every_curve(self, curve):
        compare(fused_loss, *images((2, 3, 31, 45)), WeightSpec(curve=curve, beta=3.0))

    @pytest.mark.parametrize("changes", [{"percentile": 90.0}, {"normalise": "mean"}])
    def test_specs_that_need_a_map(self, changes):
        compare(fused_loss, *images((2, 3, 31, 45)), replace(PRESETS["legs"], **changes))

    @settings(max_examples=30)
    @given(st.integers(1, 140), st.integers(1, 300), st.integers(1, 4), st.floats(0, 1), st.integers(0, 2))
    def test_any_size_and_share(self, height, width, channels, lambda_dssim, kind):
        prediction, target = images((channels, height, width))
        spread = response(target, channels_last=False).max() - response(target, channels_last=False).min()
        assume(kind != 2 or spread > 1e-3)  # two pixels respond alike but for rounding, which the weights then magnify
        compare(
            fused_loss,
            prediction,
            target,
            [None, weight_map(target, channels_last=False), PRESETS["legs-l"]][kind],
            lambda_dssim,
        )

    def test_one_map_for_a_batch(self):
        prediction, target = images((2, 3, 20, 30))
        weight = weight_map(target[0])
        expected = legs_loss(prediction.double(), target.double(), weight=weight.double())
        assert fused_loss(prediction, target, weight).item() == pytest.approx(expected.item(), rel=2e-5)

    def test_a_constant_target_has_weight_one(self):
        target = torch.full((3, 33, 47), 0.7)
        prediction = torch.rand(3, 33, 47)
        assert fused_loss(prediction, target, PRESETS["legs"]) == fused_loss(prediction, target)

    def test_gradient_is_zero_for_an_equal_prediction(self):
        target = torch.rand(3, 20, 20)
        prediction = target.clone().requires_grad_()
        loss = fused_loss(prediction, target)
        loss.backward()
        assert loss.item() == pytest.approx(0.0, abs=1e-6)
        assert float(prediction.grad.abs().max()) < 1e-7

    def test_it_repeats_bit_for_bit_on_any_number_of_threads(self):
        target = torch.rand(3, 300, 300)
        results = []
        for threads in (1, 2, 1):
            torch.set_num_threads(threads)
            prediction = (0.9 * target).requires_grad_()
            loss = fused_loss(prediction, target, PRESETS["legs"])
            loss.backward()
            results.append((loss.item(), prediction.grad))
        for value, gradient in results[1:]:
            assert value == results[0][0]
            assert torch.equal(gradient, results[0][1])

    @pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="only Linux says how long a thread ran")
    def test_it_takes_as_many_threads_as_torch(self):
        """Of each thread of a process the system counts the time on a processor, which is 0 where it took no part."""
        code = (
            "import torch\nfrom pathlib import Path\nfrom legs_loss import legs_loss, ssim, weighted_l1\n"
            "def ran():\n"
            "    tasks = Path('/proc/self/task').iterdir()\n"
            "    return {task.name: int((task / 'schedstat').read_text().split()[0]) for task in tasks}\n"
            "x, y = torch.rand(3, 260, 40, requires_grad=True), torch.rand(3, 260, 40)\n"
            "losses = (lambda: legs_loss(x, y), lambda: weighted_l1(x, y, torch.ones(260, 40)), lambda: ssim(x, y))\n"
            "for threads in (2, 1, 2):\n"
            "    torch.set_num_threads(threads)\n"
            "    seen = []\n"
            "    for _ in range(20):  # beside other work a thread may come too late\n"
            "        before = ran()\n"
            "        [loss() for loss in losses * 10]\n"
            "        seen.append(sum(time > before.get(name, 0) for name, time in ran().items()))\n"
            "    print(sorted(seen[1:])[-2 if threads == 2 else 0])\n"  # in one round another may run, as of torch
        )
        environment = dict(legs_environment(), NUMBA_NUM_THREADS="2", OMP_NUM_THREADS="2", LEGS_BACKEND="numba")
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert done.stdout.split() == ["2", "1", "2"]

    def test_non_contiguous_images_and_a_scaled_loss(self):
        target = torch.rand(20, 30, 3).movedim(-1, 0)
        prediction = torch.rand(20, 30, 3, requires_grad=True)
        (3.0 * fused_loss(prediction.movedim(-1, 0), target)).backward()
        other = prediction.detach().double().requires_grad_()
        (3.0 * legs_loss(other.movedim(-1, 0), target.double(), "3dgs")).backward()
        torch.testing.assert_close(prediction.grad.double(), other.grad, rtol=1e-4, atol=1e-8)

    def test_a_graph_that_is_retained_gives_its_gradient_again(self):
        prediction, target = images((3, 20, 30))
        loss = fused_loss(prediction, target, PRESETS["legs"])
        first = torch.autograd.grad(2.0 * loss, prediction, retain_graph=True)[0].clone()
        assert torch.equal(torch.autograd.grad(2.0 * loss, prediction)[0], first)

    def test_without_a_gradient_it_is_the_same_number(self):
        prediction, target = images((3, 40, 30))
        with torch.no_grad():
            assert fused_loss(prediction, target) == fused_loss(prediction, target)
            plain = fused_loss(prediction, target)
        assert not plain.requires_grad
        assert plain == fused_loss(prediction, target)

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), 200.0])
    def test_a_target_that_no_weight_can_be_made_from(self, value):
        prediction, target = images((3, 20, 30))
        target[1, 3, 29] = value
        with pytest.raises(LegsError, match="target"):
            fused_loss(prediction, target, PRESETS["legs"])


class TestResponse:
    @pytest.mark.parametrize("operator", COMPILED)
    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_its_extremes_are_torchs_but_for_the_last_bit(self, operator, p):
        spec = WeightSpec(operator=operator, p=p)
        for shape in ((1, 3, 1, 1), (1, 3, 1, 40), (2, 1, 5, 2), (1, 4, 33, 9), (1, 3, 40, 10), (2, 3, 70, 67)):
            image = torch.rand(shape)
            found = torch.from_numpy(extremes(image.numpy(), operator_of(spec)))
            expected = response(image, operator, p, False)[:, 0].flatten(1)
            torch.testing.assert_close(found[:, 0], expected.amin(1), rtol=3e-7, atol=0.0)
            torch.testing.assert_close(found[:, 1], expected.amax(1), rtol=3e-7, atol=0.0)
            assert not found[:, 2].any()

    @pytest.mark.parametrize("shape", [(2, 3, 33, 40), (3, 1, 5, 7), (1, 4, 270, 431)])
    @pytest.mark.parametrize("lambda_dssim", [0.0, 0.2])
    def test_those_that_its_extremes_kept_weight_as_those_that_are_made_once_more(self, shape, lambda_dssim):
        spec, made = PRESETS["legs"], []
        prediction, target = images(shape)
        for found in (None, range_of(numba_loss.BACKEND, target, spec)):
            loss = numba_loss.BACKEND.loss(terms_of(lambda_dssim), prediction, target, Weights(spec=spec, range=found))
            made.append((loss.item(), *torch.autograd.grad(loss, prediction)))
        assert made[0][0] == made[1][0] > 0.0
        assert torch.equal(made[0][1], made[1][1])

    @pytest.mark.parametrize(("value", "excess"), [(1.5, 0.5), (-3.0, 2.0), (float("inf"), float("inf"))])
    def test_values_beyond_one_are_noticed(self, value, excess):
        image = torch.rand(2, 3, 40, 50)
        image[1, 2, 39, 49] = value
        assert extremes(image.numpy(), operator_of(WeightSpec()))[:, 2].tolist() == [0.0, excess]

    def test_a_nan_is_noticed(self):
        image = torch.rand(2, 3, 40, 50)
        image[1, 0, 0, 0] = float("nan")
        assert np.isnan(extremes(image.numpy(), operator_of(WeightSpec()))[:, 2]).tolist() == [False, True]

    @pytest.mark.parametrize(("dtype", "channels"), [(np.uint8, 3), (np.uint16, 1)])
    @pytest.mark.parametrize("size", [(1, 1), (2, 900), (700, 523)])
    def test_a_photograph_is_done_in_strips(self, size, dtype, channels):
        photograph = np.random.RandomState(0).randint(0, np.iinfo(dtype).max, (*size, channels)).astype(dtype)
        for operator, p in itertools.product(COMPILED, (1.0, 2.0, float("inf"))):
            strength = photograph_response(photograph, WeightSpec(operator=operator, p=p))
            expected = response(image_tensor(photograph), operator, p, False)[0]
            torch.testing.assert_close(torch.from_numpy(strength), expected, rtol=3e-7, atol=0.0)

    def test_precompute_uses_it_for_photographs_that_are_large(self, monkeypatch):
        photograph = np.random.RandomState(0).randint(0, 255, (600, 700, 3)).astype(np.uint8)
        maps = []
        for backend in ("numba", "torch"):
            monkeypatch.setenv("LEGS_BACKEND", backend)
            maps.append(normalised_map(photograph, PRESETS["legs"]).astype(np.float32))
        assert 0.0 == maps[0].min() < maps[0].max() == 1.0
        assert np.abs(maps[0] - maps[1]).max() <= 2.0**-11  # at most the next number of float16

    @pytest.mark.parametrize("value", [0.1, 0.7, 0.9999])
    @pytest.mark.parametrize("operator", COMPILED)
    def test_a_constant_image_has_exactly_none(self, operator, value):
        image = torch.full((1, 3, 19, 31), value)
        assert extremes(image.numpy(), operator_of(WeightSpec(operator=operator))).tolist() == [[0.0, 0.0, 0.0]]


@pytest.fixture
def chosen(monkeypatch):
    """Return a function that sets LEGS_BACKEND; clear the backends' findings before and after."""
    monkeypatch.setattr(BACKENDS, "found", {})
    monkeypatch.delenv("LEGS_BACKEND", raising=False)
    return lambda name: monkeypatch.setenv("LEGS_BACKEND", name)


class TestSelection:
    def test_a_weighted_loss_on_the_cpu_is_numbas(self, chosen):
        prediction, target = images((3, 20, 30))
        assert used(legs_loss(prediction, target)) == "fused"
        assert used(legs_loss(prediction, target, "3dgs", weight=weight_map(target))) == "fused"
        assert used(LEGSLoss()(prediction, target)) == "fused"

    def test_3dgs_own_loss_stays_torchs_to_the_last_bit(self, chosen):
        prediction, target = images((3, 20, 30))
        assert used(legs_loss(prediction, target, "3dgs")) == "torch"
        chosen("numba")
        assert used(legs_loss(prediction, target, "3dgs")) == "fused"

    def test_torch_can_be_forced(self, chosen):
        chosen("torch")
        assert used(legs_loss(*images((3, 20, 30)))) == "torch"

    @pytest.mark.parametrize(
        "case", ["double", "five channels", "reflect", "l1 alone", "weight learns", "target learns"]
    )
    def test_what_numba_does_not_take_is_torchs(self, chosen, case):
        prediction, target = images((5 if case == "five channels" else 3, 20, 30))
        weight = torch.ones(1, 20, 30, requires_grad=case == "weight learns")
        if case == "double":
            prediction, target = prediction.double(), target.double()
        target.requires_grad_(case == "target learns")
        padding, share = "reflect" if case == "reflect" else "zeros", 0.0 if case == "l1 alone" else 0.2
        channels_last = False if case == "five channels" else None
        loss = legs_loss(
            prediction, target, weight=weight, padding=padding, lambda_dssim=share, channels_last=channels_last
        )
        assert used(loss) == "torch"
        loss.backward()

    def test_an_operator_that_is_not_compiled_is_torchs(self, chosen, monkeypatch, capfd):
        wide = Operator("wide", (((0, 0, 1, 0, 0), (0,) * 5, (1, 0, -4, 0, 1), (0,) * 5, (0, 0, 1, 0, 0)),), "a test")
        monkeypatch.setitem(OPERATORS, "wide", wide)
        prediction, target = images((3, 40, 50))
        loss = legs_loss(prediction, target, WeightSpec(operator="wide"))
        exact = legs_loss(prediction.double(), target.double(), WeightSpec(operator="wide"))
        assert loss.item() == pytest.approx(exact.item(), rel=2e-5)
        assert used(loss) == "fused"  # with torch's map
        photograph = (torch.rand(1200, 400, 3) * 255).byte().numpy()
        expected = response(image_tensor(photograph), "wide")
        low, high = expected.aminmax()
        stored = torch.from_numpy(normalised_map(photograph, WeightSpec(operator="wide")))
        torch.testing.assert_close(stored.float(), ((expected - low) / (high - low + 1e-8))[0], rtol=0, atol=2.0**-11)
        assert used(legs_loss(prediction, target)) == "fused"
        assert capfd.readouterr().err == ""

    @pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
    @pytest.mark.parametrize("loss", [legs_loss, l1_loss, ssim], ids=["legs_loss", "l1_loss", "ssim"])
    def test_cuda_without_cuda_is_an_error(self, chosen, loss):
        chosen("cuda")
        with pytest.raises(LegsError, match=r"LEGS_BACKEND=cuda, but .*CUDA.*: unset LEGS_BACKEND"):
            loss(*images((3, 20, 30)))

    def test_an_unknown_backend_is_an_error(self, chosen):
        chosen("metal")
        with pytest.raises(LegsError, match="LEGS_BACKEND must be one of torch, numba, cuda, got 'metal'"):
            legs_loss(*images((3, 20, 30)))

    @pytest.mark.parametrize(
        "options",
        itertools.chain(
            [{"mask": m, "renormalise": r} for m, r in itertools.product(["[H, W]", "[1, H, W]"], [False, True])],
            [{"channels_last": True}, {"channels_last": True, "mask": "[H, W]"}, {"weight": True, "mask": "[H, W]"}],
        ),
        ids=str,
    )
    @pytest.mark.parametrize("batch", [(), (2,)])
    def test_the_options_of_legs_loss_mean_the_same(self, chosen, options, batch):
        options = dict(options)
        shape = (*batch, 3, 24, 31)
        prediction, target = torch.rand(shape), torch.rand(shape)
        if "mask" in options:
            options["mask"] = (torch.rand(24, 31) > 0.4).reshape((1, 24, 31) if "1" in options["mask"] else (24, 31))
        if options.pop("weight", False):
            options["weight"] = 1.0 + torch.rand(24, 31)
        if options.get("channels_last"):
            prediction, target = prediction.movedim(-3, -1), target.movedim(-3, -1)
        results = []
        for name in ("numba", "torch"):
            chosen(name)
            image = prediction.clone().requires_grad_()
            loss = legs_loss(image, target, **options)
            assert used(loss) == ("torch" if name == "torch" else "fused")
            loss.backward()
            results.append((loss, image.grad))
        assert results[0][0].item() == pytest.approx(results[1][0].item(), rel=1e-5)
        torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-3, atol=1e-8)

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    def test_half_precision_is_computed_in_float32(self, chosen, dtype):
        prediction, target = (0.1 + 0.8 * torch.rand(3, 20, 30)).to(dtype), torch.rand(3, 20, 30).to(dtype)
        prediction.requires_grad_()
        loss = legs_loss(prediction, target)
        loss.backward()
        assert used(loss) == "fused"
        assert loss.dtype == torch.float32 and prediction.grad.dtype == dtype
        exact = prediction.detach().double().requires_grad_()
        expected = legs_loss(exact, target.double())
        expected.backward()
        assert loss.item() == pytest.approx(expected.item(), rel=2e-5)
        # the gradient is rounded to the prediction's type once: float16's smallest steps are 6e-8
        error = prediction.grad.double() - exact.grad
        assert float(error.abs().max()) <= max(float(torch.finfo(dtype).eps) * float(exact.grad.abs().max()), 6e-8)

    def test_torch_func_still_differentiates(self, chosen):
        func = pytest.importorskip("torch.func")
        prediction, target = images((3, 20, 30))
        gradient = func.grad(lambda image: legs_loss(image, target))(prediction.detach())
        legs_loss(prediction, target).backward()
        torch.testing.assert_close(gradient, prediction.grad, rtol=1e-3, atol=1e-8)

    def test_a_broken_backend_is_named_once_and_never_fatal(self, chosen, monkeypatch, capfd):
        def broken(*_):
            raise RuntimeError("no such instruction\nsecond line")

        monkeypatch.setattr("legs_loss.kernels.numba_loss._NumbaLoss", broken)
        for _ in range(3):
            assert used(legs_loss(*images((3, 20, 30)))) == "torch"
        said = capfd.readouterr().err.replace(OF_THE_FIRST_STEP, "")
        assert said == "legs-loss: numba is unavailable, torch is used: RuntimeError: no such instruction\n"

    def test_memory_that_is_to_be_read_negated_is_torchs(self, chosen, capfd):
        image, target = images((3, 20, 30))
        negated = torch._neg_view(-image.detach()).requires_grad_()
        for pair in ((negated, target), (image, torch._neg_view(-target))):
            loss = legs_loss(*pair)
            assert used(loss) == "torch"
            assert loss.item() == pytest.approx(legs_loss(image.double(), target.double()).item(), rel=2e-5)
        assert used(legs_loss(image, target)) == "fused"  # it was not given up
        assert "unavailable" not in capfd.readouterr().err

    def test_a_backend_that_fails_after_its_trial_is_left(self, chosen, monkeypatch, capfd):
        own = numba_loss._NumbaLoss.compute

        def breaks_at_four_channels(self, prediction, *rest):
            if prediction.shape[0] == 4:
                raise RuntimeError("out of resource: shared memory")
            return own(self, prediction, *rest)

        monkeypatch.setattr(numba_loss._NumbaLoss, "compute", breaks_at_four_channels)
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"
        for channels in (4, 4, 3):
            assert used(legs_loss(*images((channels, 20, 30)))) == "torch"
        said = capfd.readouterr().err.replace(OF_THE_FIRST_STEP, "")
        assert said == "legs-loss: numba is unavailable, torch is used: RuntimeError: out of resource: shared memory\n"

    def test_a_backend_that_computes_something_else_is_found_out(self, chosen, monkeypatch, capfd):
        own = numba_loss._NumbaLoss.compute

        def more(*given):
            loss, gradient = own(*given)
            return 1.01 * loss, gradient

        monkeypatch.setattr(numba_loss._NumbaLoss, "compute", more)
        assert used(legs_loss(*images((3, 20, 30)))) == "torch"
        assert "its trial of the loss gave" in capfd.readouterr().err

    def test_an_evaluation_that_comes_first_does_not_spoil_the_trial(self, chosen):
        """In inference mode nothing has a gradient, which the trial compares."""
        with torch.inference_mode():
            legs_loss(torch.rand(3, 20, 30), torch.rand(3, 20, 30))
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"

    def test_a_broken_install(self, tmp_path):
        (tmp_path / "numba").mkdir()
        (tmp_path / "numba" / "__init__.py").write_text("raise ImportError('needs NumPy 1.99 or less')\n")
        code = (
            "import torch, legs_loss\n"
            "x = torch.rand(3, 16, 16, requires_grad=True)\n"
            "for _ in range(2): legs_loss.legs_loss(x, torch.rand(3, 16, 16)).backward()\n"
            "assert x.grad.abs().sum() > 0\n"
        )
        environment = legs_environment()
        environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
        environment.pop("LEGS_BACKEND", None)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stderr
        assert (
            done.stderr.count("legs-loss: numba is unavailable, torch is used: ImportError: needs NumPy 1.99 or less")
            == 1
        )

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
    def test_a_forked_process_starts_threads_of_its_own(self, chosen):
        code = (
            "import os, torch\nfrom legs_loss import legs_loss\ntorch.set_num_threads(2)\n"
            "x, y = torch.rand(3, 90, 700, requires_grad=True), torch.rand(3, 90, 700)\n"
            "legs_loss(x, y).backward()\n"
            "gradient, x.grad = x.grad, None\n"
            "child = os.fork()\n"
            "if child == 0:\n"
            "    loss = legs_loss(x, y)\n"
            "    os._exit(0 if type(loss.grad_fn).__name__ == '_FusedLossBackward' else 1)\n"
            "assert os.waitpid(child, 0)[1] == 0\n"
        )
        done = run([sys.executable, "-c", code], env=legs_environment())
        assert done.returncode == 0, done.stderr
