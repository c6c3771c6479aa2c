"""Transforms of torch over the losses: each gives the weighted value and gradient, or one error of ours."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

from legs_loss import LegsError, LEGSLoss, configure, l1_loss, legs_loss, masked, ssim, weight_map, weighted_l1
from legs_loss.precompute import UserMaps, precompute
from legs_loss.runtime import counts, state
from legs_loss.scenes import read_scene
from tests.runtime.support import plain
from tests.support import colmap_scene, photograph, save

try:
    from torch import func
except ImportError:  # it came with torch 2.0
    func = None

needs_func = pytest.mark.skipif(func is None, reason="this torch has no torch.func")
HEIGHT, WIDTH = 14, 17


def weights_by_hand(target):
    """Return W of preset "legs" in float64: Laplacian of 4 neighbours, 2-norm, sqrt, beta 10."""
    padded = F.pad(target.double()[None], (1, 1, 1, 1), mode="reflect")[0]
    near = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    strength = (near - 4 * target.double()).norm(dim=0)
    return 1 + 10 * ((strength - strength.min()) / (strength.max() - strength.min() + 1e-8)).sqrt()


def l1_by_hand(prediction, target):
    return (weights_by_hand(target) * (prediction - target.double()).abs()).mean()


def ssim_by_hand(prediction, target):
    taps = torch.exp(-((torch.arange(11.0) - 5) ** 2) / 4.5).float()
    taps = (taps / taps.sum())[:, None]
    window = taps.mm(taps.t()).double().expand(3, 1, 11, 11)

    def blur(image):
        return F.conv2d(image[None], window, padding=5, groups=3)

    x, y = prediction.double(), target.double()
    both = blur(x * y) - blur(x) * blur(y)
    spread = blur(x * x) - blur(x) ** 2 + blur(y * y) - blur(y) ** 2
    found = (2 * blur(x) * blur(y) + 1e-4) * (2 * both + 9e-4)
    return (found / ((blur(x) ** 2 + blur(y) ** 2 + 1e-4) * (spread + 9e-4))).mean()


def whole_by_hand(prediction, target):
    return 0.8 * l1_by_hand(prediction, target) + 0.2 * (1 - ssim_by_hand(prediction, target))


LOSSES = {
    "l1_loss": (l1_loss, l1_by_hand),
    "legs_loss": (legs_loss, whole_by_hand),
    "LEGSLoss": (LEGSLoss(), whole_by_hand),
    "ssim": (ssim, ssim_by_hand),
    "weighted_l1": (lambda image, target: weighted_l1(image, target, weight_map(target)), l1_by_hand),
}


@pytest.fixture(params=LOSSES)
def loss(request):
    return LOSSES[request.param][0]


@pytest.fixture
def by_hand(request, loss):
    return dict(LOSSES.values())[loss]


@pytest.fixture(autouse=True)
def fresh_settings(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    state.reset()
    yield
    state.reset()


def images(views=0):
    shape = (views, 3, HEIGHT, WIDTH) if views else (3, HEIGHT, WIDTH)
    return torch.rand(shape), torch.rand(shape)


def checked(by_hand, image, target, value=None, gradient=None):
    """Compare a value and a gradient with those of float64."""
    exact = image.detach().double().requires_grad_()
    expected = by_hand(exact, target)
    (slope,) = torch.autograd.grad(expected, exact)
    if value is not None:
        assert float(value) == pytest.approx(float(expected), rel=1e-5)
    if gradient is not None:
        torch.testing.assert_close(gradient.double(), slope, rtol=1e-3, atol=1e-7)


@needs_func
class TestFunc:
    def test_grad(self, loss, by_hand):
        image, target = images()
        gradient, value = func.grad_and_value(loss)(image, target)
        checked(by_hand, image, target, value, gradient)
        checked(by_hand, image, target, None, func.grad(lambda one: loss(one, target))(image))

    @pytest.mark.parametrize("jacobian", ["jacrev", "jacfwd"])
    def test_jacobians(self, loss, by_hand, jacobian):
        image, target = images()
        checked(by_hand, image, target, None, getattr(func, jacobian)(loss)(image, target))

    def test_jvp(self, loss, by_hand):
        image, target = images()
        tangent = torch.rand_like(image)
        value, change = func.jvp(lambda one: loss(one, target), (image,), (tangent,))
        exact = image.double().requires_grad_()
        (slope,) = torch.autograd.grad(by_hand(exact, target), exact)
        checked(by_hand, image, target, value)
        assert float(change) == pytest.approx(float((slope * tangent).sum()), rel=1e-4)

    def test_vmap_of_images_that_are_trained(self, loss, by_hand):
        predictions, targets = images(views=2)
        trained = predictions.clone().requires_grad_()
        values = func.vmap(loss)(trained, targets)
        values.sum().backward()
        for image, target, value, gradient in zip(predictions, targets, values, trained.grad):
            checked(by_hand, image, target, value, gradient)

    def test_vmap_within_and_around_grad_and_jvp(self, loss, by_hand):
        predictions, targets = images(views=2)
        around = func.vmap(func.grad(loss))(predictions, targets)
        within = func.grad(lambda all_views: func.vmap(loss)(all_views, targets).sum())(predictions)
        values, _ = func.jvp(lambda all_views: func.vmap(loss)(all_views, targets), (predictions,), (predictions,))
        for view in range(2):
            checked(by_hand, predictions[view], targets[view], values[view], around[view])
            checked(by_hand, predictions[view], targets[view], None, within[view])

    def test_vmap_of_an_evaluation_is_plain(self):
        predictions, targets = images(views=2)
        torch.testing.assert_close(
            func.vmap(l1_loss)(predictions, targets), (predictions - targets).abs().mean((1, 2, 3))
        )

    def test_hessian(self, loss, by_hand):
        image, target = images()
        few, rest = image.flatten()[:5], image.flatten()[5:]

        def of_few(function, others):
            return lambda values: function(torch.cat([values, others]).reshape(3, HEIGHT, WIDTH), target)

        expected = torch.autograd.functional.hessian(of_few(by_hand, rest.double()), few.double())
        torch.testing.assert_close(func.hessian(of_few(loss, rest))(few).double(), expected, rtol=1e-3, atol=1e-6)

    def test_functionalize(self, loss, by_hand):
        image, target = images()
        checked(by_hand, image, target, func.functionalize(loss)(image.clone().requires_grad_(), target))

    def test_swapped_images_are_refused_here_too(self):
        image, target = images()
        for swapped in (lambda one: l1_loss(target, one), lambda one: legs_loss(target, one)):
            with pytest.raises(LegsError, match="turn them round"):
                func.grad(swapped)(image)
            with pytest.raises(LegsError, match="turn them round"):
                func.jvp(swapped, (image,), (image,))

    def test_a_step_after_a_transform_is_as_before_it(self, loss, by_hand):
        image, target = images()
        func.grad(lambda one: loss(one, target))(image)
        trained = image.clone().requires_grad_()
        value = loss(trained, target)
        value.backward()
        checked(by_hand, image, target, value, trained.grad)

    def test_make_fx_records_operations_and_no_constant(self):
        from torch.fx.experimental.proxy_tensor import make_fx

        image, target = images()
        other = torch.rand_like(image)
        graph = make_fx(lambda one, other: legs_loss(one, other))(image.clone().requires_grad_(), target)
        checked(whole_by_hand, other, target, graph(other.clone().requires_grad_(), target))


class TestAutograd:
    def test_forward_mode(self, loss, by_hand):
        image, target = images()
        tangent = torch.rand_like(image)
        for trained in (image, image.clone().requires_grad_()):
            with forward_ad.dual_level():
                value, change = forward_ad.unpack_dual(loss(forward_ad.make_dual(trained, tangent), target))
            exact = image.double().requires_grad_()
            (slope,) = torch.autograd.grad(by_hand(exact, target), exact)
            checked(by_hand, image, target, value)
            assert float(change) == pytest.approx(float((slope * tangent).sum()), rel=1e-4)

    def test_a_batch_of_factors(self, loss, by_hand):
        image, target = images()
        trained = image.clone().requires_grad_()
        gradients = torch.autograd.grad(loss(trained, target), trained, torch.tensor([1.0, 3.0]), is_grads_batched=True)
        checked(by_hand, image, target, None, gradients[0][0])
        checked(by_hand, image, target, None, gradients[0][1] / 3)

    def test_a_second_derivative_is_right_or_refused(self, loss, by_hand, monkeypatch):
        image, target = images()

        def second(function, start):
            trained = start.clone().requires_grad_()
            (slope,) = torch.autograd.grad(function(trained, target), trained, create_graph=True)
            return torch.autograd.grad((slope * slope).sum() + (slope * trained).sum(), trained)[0]

        expected = second(by_hand, image.double())
        monkeypatch.setenv("LEGS_BACKEND", "torch")
        torch.testing.assert_close(second(loss, image).double(), expected, rtol=1e-3, atol=1e-6)
        monkeypatch.delenv("LEGS_BACKEND")
        if loss is LOSSES["weighted_l1"][0]:  # by torch in any case
            torch.testing.assert_close(second(loss, image).double(), expected, rtol=1e-3, atol=1e-6)
            return
        pytest.importorskip("numba")
        with pytest.raises(LegsError, match="LEGS_BACKEND=torch"):
            second(loss, image)

    def test_a_first_derivative_with_create_graph(self, loss, by_hand):
        image, target = images()
        trained = image.clone().requires_grad_()
        (slope,) = torch.autograd.grad(2 * loss(trained, target), trained, create_graph=True)
        checked(by_hand, image, target, None, slope.detach() / 2)


@pytest.mark.filterwarnings("ignore:None of the inputs")
@pytest.mark.parametrize("reentrant", [True, False])
class TestCheckpoint:
    def test_value_and_gradient(self, loss, by_hand, reentrant):
        image, target = images()
        for function in (loss, lambda one, other: loss(one.mul(1.0), other)):  # the image is given, or rendered within
            trained = image.clone().requires_grad_()
            value = checkpoint(function, trained, target, use_reentrant=reentrant)
            value.backward()
            checked(by_hand, image, target, value, trained.grad)

    def test_nested(self, loss, by_hand, reentrant):
        image, target = images()

        def outer(one, other):
            return checkpoint(loss, one * 1.0, other, use_reentrant=reentrant)

        trained = image.clone().requires_grad_()
        value = checkpoint(outer, trained, target, use_reentrant=reentrant)
        value.backward()
        checked(by_hand, image, target, value, trained.grad)

    def test_an_evaluation_is_plain(self, reentrant):
        image, target = images()
        with torch.no_grad():
            value = checkpoint(l1_loss, image.requires_grad_(), target, use_reentrant=reentrant)
        assert float(value) == pytest.approx(float(plain(image, target)))

    def test_a_step_is_counted(self, reentrant):
        image, target = images()
        before = counts().weighted
        checkpoint(l1_loss, image.requires_grad_(), target, use_reentrant=reentrant).backward()
        assert counts().weighted - before == 1


class Contextual(torch.autograd.Function):
    """A codebase's own node around the loss, with the plain gradient."""

    @staticmethod
    def forward(context, image, target):
        context.save_for_backward(image, target)
        return l1_loss(image, target)

    @staticmethod
    def backward(context, gradient):
        image, target = context.saved_tensors
        return gradient * (image - target).sign() / image.numel(), None


class SetUp(Contextual):
    """The same in the form of torch 2: its forward has no context."""

    @staticmethod
    def forward(image, target):
        return l1_loss(image, target)

    @staticmethod
    def setup_context(context, inputs, output):
        context.save_for_backward(*inputs)


class TestFunctionOfACodebase:
    @pytest.mark.parametrize("function", [Contextual, pytest.param(SetUp, marks=needs_func)])
    def test_it_is_weighted_and_counted(self, function):
        image, target = images()
        before = counts().weighted
        value = function.apply(image.requires_grad_(), target)
        value.backward()
        torch.testing.assert_close(value.double(), l1_by_hand(image.double(), target), rtol=1e-5, atol=1e-7)
        assert counts().weighted - before == 1
        assert float(function.apply(image.detach(), target)) == pytest.approx(float(plain(image, target)))

    def test_an_evaluation_is_plain(self):
        image, target = images()
        with torch.no_grad():
            assert float(Contextual.apply(image.requires_grad_(), target)) == pytest.approx(float(plain(image, target)))


class TestStore:
    @pytest.fixture
    def target(self, tmp_path):
        """A photograph of a scene whose store has a mask, and the share of the image that counts."""
        scene = colmap_scene(tmp_path / "scene", width=WIDTH, height=HEIGHT)
        mask = photograph(WIDTH, HEIGHT, channels=1) * 0 + 255
        mask[:4] = 0
        for name in ("0001", "0002", "0003"):
            save(scene / "masks" / f"{name}.png", mask)
        precompute(read_scene(scene), maps=UserMaps(masks="masks"))
        configure("legs", store=scene / "legs_weights")
        return torch.from_numpy(photograph(WIDTH, HEIGHT)).float().div(255).movedim(-1, 0)

    @pytest.fixture(params=["l1_loss", "LEGSLoss", "masked"])
    def function(self, request, target, tmp_path):
        whole = LEGSLoss(store=tmp_path / "scene" / "legs_weights")
        return {"l1_loss": l1_loss, "LEGSLoss": whole, "masked": lambda a, b: masked(a, b).sum()}[request.param]

    @needs_func
    def test_masks_cannot_be_looked_up_and_it_is_said(self, function, target):
        image = torch.rand_like(target)
        with pytest.raises(LegsError, match=r"torch.func and forward-mode AD cannot look"):
            func.grad(function)(image, target)
        with pytest.raises(LegsError, match=r"torch.func and forward-mode AD cannot look"):
            func.jvp(lambda one: function(one, target), (image,), (image,))
        with pytest.raises(LegsError, match=r"torch.func and forward-mode AD cannot look"):
            func.vmap(function)(image[None].requires_grad_(), target[None])

    @pytest.mark.parametrize("reentrant", [True, False])
    def test_a_checkpoint_is_masked(self, target, reentrant):
        image = torch.rand_like(target)
        trained = image.clone().requires_grad_()
        value = checkpoint(l1_loss, trained, target, use_reentrant=reentrant)
        value.backward()
        covered = (HEIGHT - 4) / HEIGHT
        error = weights_by_hand(target) * (image.double() - target).abs()
        assert float(value) == pytest.approx(float(error[:, 4:].sum() / error.numel() / covered), rel=1e-3)
        assert not trained.grad[:, :4].any()

    @needs_func
    def test_without_masks_the_weight_is_the_targets(self, tmp_path):
        scene = colmap_scene(tmp_path / "scene", width=WIDTH, height=HEIGHT)
        precompute(read_scene(scene))
        configure("legs", store=scene / "legs_weights")
        target = torch.from_numpy(photograph(WIDTH, HEIGHT)).float().div(255).movedim(-1, 0)
        image = torch.rand_like(target)
        checked(l1_by_hand, image, target, None, func.grad(l1_loss)(image, target))
        assert counts().stored == 0
