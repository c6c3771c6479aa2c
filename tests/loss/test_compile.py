"""torch.compile(fullgraph=True) of the losses, as a training script calls them: value and gradient equal eager's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest
import torch
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

from legs_loss import LEGSLoss, WeightSpec, l1_loss, legs_loss, ssim, weight_map, weighted_l1
from legs_loss.runtime import state
from tests.loss.test_transforms import Contextual, SetUp
from tests.support import legs_environment


def _compiles() -> bool:
    if not hasattr(torch, "compile"):
        return False
    supported = getattr(torch._dynamo, "is_dynamo_supported", None)  # by this Python and platform
    return supported is None or bool(supported())


MASK = torch.linspace(0.0, 1.0, 16 * 20).reshape(16, 20)
LOSSES = {
    "legs_loss": legs_loss,
    "legs_loss of a map and a mask": lambda a, b: legs_loss(a, b, weight=weight_map(b), mask=MASK, renormalise=True),
    "legs_loss, Sobel and C5": lambda a, b: legs_loss(a, b, WeightSpec(operator="sobel", p=1.0, curve="C5")),
    "legs_loss, unweighted": lambda a, b: legs_loss(a, b, "3dgs"),
    "LEGSLoss": LEGSLoss(),
    "l1_loss": l1_loss,
    "l1_loss and ssim, a step of 3DGS": lambda a, b: 0.8 * l1_loss(a, b) + 0.2 * (1.0 - ssim(a, b)),
    "weighted_l1": lambda a, b: weighted_l1(a, b, weight_map(b)),
}


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Each test is a run of its own, started in an empty folder; nothing is compiled yet."""
    if not _compiles():  # asked here, since torch's compiler takes a second to import
        pytest.skip("this torch has no torch.compile for this Python")
    for name in [name for name in os.environ if name.startswith("LEGS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    monkeypatch.chdir(tmp_path)
    state.reset()
    torch._dynamo.reset()


def value_and_gradient(loss, prediction, target):
    value = loss(prediction, target)
    return value.detach(), torch.autograd.grad(value, prediction)[0]


@pytest.mark.parametrize("name", LOSSES)
def test_value_and_gradient_are_those_of_eager_from_the_first_call(name):
    loss = LOSSES[name]
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    for _ in range(2):  # the second call runs what the first one compiled, with other pixels
        prediction, target = torch.rand(3, 16, 20, requires_grad=True), torch.rand(3, 16, 20)
        found = value_and_gradient(compiled, prediction, target)
        for mine, eager in zip(found, value_and_gradient(loss, prediction, target)):
            torch.testing.assert_close(mine, eager, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("dynamic", [None, True])
@pytest.mark.parametrize("axes", [(3, 0, 0), (0, 0, 3), (2, 3, 0, 0), (2, 0, 0, 3), (0, 0)], ids=str)
@pytest.mark.parametrize(
    "loss", [l1_loss, ssim, legs_loss, LEGSLoss()], ids=["l1_loss", "ssim", "legs_loss", "LEGSLoss"]
)
def test_portrait_and_landscape_in_one_capture(loss, axes, dynamic):
    compiled = torch.compile(loss, fullgraph=True, backend="eager", dynamic=dynamic)
    for sides in ((16, 20), (16, 25), (25, 20), (20, 16)):  # another width, another height, turned round
        left = iter(sides)
        shape = [size or next(left) for size in axes]
        prediction, target = torch.rand(shape, requires_grad=True), torch.rand(shape)
        found = value_and_gradient(compiled, prediction, target)
        for mine, eager in zip(found, value_and_gradient(loss, prediction, target)):
            torch.testing.assert_close(mine, eager, rtol=1e-4, atol=1e-6)


TRANSFORMS = {
    "grad": lambda a, b: torch.func.grad(l1_loss)(a, b),
    "vmap": lambda a, b: torch.func.vmap(l1_loss)(a[None], b[None]),
    "jvp": lambda a, b: torch.func.jvp(lambda one: l1_loss(one, b), (a,), (a,)),
    "forward AD": lambda a, b: _dual(l1_loss, a, b),
}


def _dual(loss, image, target):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(loss(forward_ad.make_dual(image, image), target)).primal


@pytest.mark.skipif(not hasattr(torch, "func"), reason="this torch has no torch.func")
class TestWithATransform:
    """A graph does not show whether `l1_loss` is trained: one error, never the plain mean in silence."""

    @pytest.mark.parametrize("name", TRANSFORMS)
    def test_within_a_graph(self, name):
        image, target = torch.rand(3, 9, 8), torch.rand(3, 9, 8)
        with pytest.raises(Exception, match=r"with torch\.compile: the graph does not show"):
            torch.compile(TRANSFORMS[name], backend="eager")(image, target)

    def test_around_a_graph(self):
        image, target = torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8)
        compiled = torch.compile(l1_loss, backend="eager")
        for around in (
            lambda: torch.func.vmap(compiled)(image[None], target[None]),
            lambda: checkpoint(compiled, image, target, use_reentrant=True),
            lambda: _dual(compiled, image.detach(), target),
        ):
            torch._dynamo.reset()
            with pytest.raises(Exception, match=r"with torch\.compile: the graph does not show"):
                around()

    @pytest.mark.parametrize("name", ["with a context", "with its own setup"])
    def test_a_function_of_ours_in_a_graph(self, name):
        function = {"with a context": Contextual, "with its own setup": SetUp}[name]
        image, target = torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8)
        with pytest.raises(Exception, match=r"with torch\.compile: the graph does not show"):
            torch.compile(function.apply, backend="eager")(image, target)
        torch._dynamo.reset()
        with torch.no_grad():  # an evaluation has no node
            found = torch.compile(function.apply, backend="eager")(image.detach(), target)
        torch.testing.assert_close(found, (image - target).abs().mean().detach())

    def test_what_is_always_weighted_is_computed(self):
        image, target = torch.rand(3, 16, 20), torch.rand(3, 16, 20)
        compiled = torch.compile(lambda a, b: torch.func.grad(legs_loss)(a, b), backend="eager")
        expected = value_and_gradient(legs_loss, image.clone().requires_grad_(), target)[1]
        torch.testing.assert_close(compiled(image, target), expected, rtol=1e-4, atol=1e-7)

    def test_what_is_off_is_plain(self, monkeypatch):
        monkeypatch.setenv("LEGS_OFF", "1")
        image, target = torch.rand(3, 9, 8), torch.rand(3, 9, 8)
        compiled = torch.compile(TRANSFORMS["grad"], backend="eager")
        torch.testing.assert_close(compiled(image, target), (image - target).sign() / image.numel())


SCRIPT = """
import torch
from legs_loss import LEGSLoss, l1_loss, legs_loss

torch.manual_seed(0)
for loss in (legs_loss, l1_loss, LEGSLoss("legs-l")):
    compiled = torch.compile(loss, fullgraph=True)
    results = []
    prediction, target = torch.rand(3, 16, 20, requires_grad=True), torch.rand(3, 16, 20)
    for function in (compiled, loss):  # compiled first: nothing was asked of the package before
        value = function(prediction, target)
        results.append((value.detach(), *torch.autograd.grad(value, prediction)))
    for mine, eager in zip(*results):
        torch.testing.assert_close(mine, eager, rtol=1e-4, atol=1e-7)
print("equal")
"""


@pytest.mark.slow
@pytest.mark.skipif(not (os.environ.get("CXX") or shutil.which("g++")), reason="torch.compile needs a C++ compiler")
def test_a_script_whose_first_call_is_compiled(tmp_path):
    script = tmp_path / "train.py"
    script.write_text(SCRIPT)
    environment = {key: value for key, value in legs_environment().items() if not key.startswith("LEGS_")}
    done = subprocess.run(
        [sys.executable, str(script)], cwd=str(tmp_path), env=environment, capture_output=True, text=True
    )
    assert done.stdout == "equal\n", done.stderr[-3000:]
