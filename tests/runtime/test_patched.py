"""l1_loss as the lines that legs-patch writes call it: unreduced maps, the codebase's own L1, both layouts."""

from __future__ import annotations

import sys
import threading
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from torch.utils.checkpoint import checkpoint

from legs_loss import LegsError, configure, l1_loss, unweighted, weight_map
from legs_loss.runtime import active, counts


def pair(*shape):
    prediction, target = torch.rand(shape), torch.rand(shape)
    prediction.view(-1)[::5] = target.view(-1)[::5]  # where they are equal the gradient is 0
    return prediction.requires_grad_(True), target


def gradient(loss, prediction):
    (found,) = torch.autograd.grad(loss, prediction)
    return found


def masked(network_output, gt, mask=None):
    if mask is None:
        return torch.abs(network_output - gt).mean()
    return torch.abs((network_output - gt) * mask).sum() / mask.sum()


def valid(network_output, gt):
    error = torch.abs(network_output - gt)
    error = torch.where(gt != 0, error, torch.zeros_like(error))
    return error, error.mean()


def charbonnier(a, b, epsilon=1e-3):
    return torch.sqrt((a - b) ** 2 + epsilon**2).mean()


def truncated(a, b):
    error = torch.abs(a - b)
    return error[error < 0.1].mean()


L1 = {
    "torch's": F.l1_loss,
    "a module, summed": torch.nn.L1Loss(reduction="sum"),
    "scaled": lambda a, b: 0.8 * F.l1_loss(a, b),
    "of pixels of the photograph": lambda a, b: torch.abs(a - b)[b > 0].mean(),
    "of no pixel": lambda a, b: torch.abs(a - b)[b > 2].mean(),
    "with its mask": lambda a, b: (torch.abs(a - b), b > 0),
    "in a dictionary": lambda a, b: {"l1": F.l1_loss(a, b)},
    "of gradients": lambda a, b: F.l1_loss(a, b) + F.l1_loss(a[..., 1:] - a[..., :-1], b[..., 1:] - b[..., :-1]),
    "of samples": lambda a, b: (torch.abs(a - b) * (torch.rand(a.shape) > 0.5)).mean(),
    "Charbonnier's": charbonnier,
}
NO_L1 = {
    "squared": F.mse_loss,
    "squared by a module": torch.nn.MSELoss(),
    "squared by parts": partial(F.mse_loss, reduction="sum"),
    "squared in a lambda": lambda a, b: ((a - b) ** 2 * (b > 0)).sum(),
    "smooth": F.smooth_l1_loss,
    "Huber's": torch.nn.HuberLoss(delta=0.1),
    "smoother than usual": partial(charbonnier, epsilon=0.05),
    "truncated": truncated,
    "clamped": lambda a, b: F.l1_loss(a.clamp(0, 1), b),
}
WAYS = {
    "grad": lambda f, image: torch.func.grad(f)(image.detach()),
    "vmap": lambda f, image: torch.func.vmap(torch.func.grad(f))(image.detach()),
    "jvp": lambda f, image: torch.func.jvp(f, (image.detach(),), (torch.ones_like(image),)),
    "checkpoint": lambda f, image: checkpoint(f, image, use_reentrant=True),
}


class TestUnreduced:
    def test_is_the_weight_times_the_error(self):
        prediction, target = pair(3, 6, 5)
        expected = weight_map(target, "legs") * torch.abs(prediction - target)
        assert torch.equal(l1_loss(prediction, target, reduction="none"), expected)
        assert torch.equal(l1_loss(prediction, target, reduction="none").mean(), l1_loss(prediction, target))

    def test_channels_last_and_a_mask_taken_afterwards(self):
        prediction, target = pair(2, 6, 5, 3)
        mask = torch.rand(2, 6, 5) > 0.5
        weight = torch.stack([weight_map(image, "legs", channels_last=True) for image in target])
        expected = (weight * torch.abs(prediction - target))[mask].mean()
        found = l1_loss(prediction, target, reduction="none")[mask].mean()
        assert torch.equal(found, expected)

    def test_a_mask_multiplies_it(self):
        prediction, target = pair(3, 6, 5)
        mask = torch.rand(6, 5)
        expected = mask * (weight_map(target, "legs") * torch.abs(prediction - target))
        assert torch.allclose(l1_loss(prediction, target, mask=mask, reduction="none"), expected)

    def test_another_reduction_is_refused(self):
        with pytest.raises(LegsError, match='reduction must be "mean" or "none"'):
            l1_loss(*pair(3, 4, 4), reduction="sum")


class TestOwn:
    def test_a_mean_of_its_own_becomes_the_weighted_mean(self):
        prediction, target = pair(3, 7, 6)
        found = l1_loss(prediction, target, own=F.l1_loss)
        assert torch.allclose(found, l1_loss(prediction, target), rtol=1e-5)
        assert torch.allclose(gradient(found, prediction), gradient(l1_loss(prediction, target), prediction), rtol=1e-4)

    def test_a_masked_mean_of_its_own(self):
        prediction, target = pair(3, 7, 6)
        mask = (torch.rand(1, 7, 6) > 0.5).float()
        expected = (weight_map(target, "legs") * torch.abs(prediction - target) * mask).sum() / mask.sum()
        found = l1_loss(prediction, target, own=lambda a, b: masked(a, b, mask))
        assert torch.allclose(found, expected, rtol=1e-5)

    def test_a_mask_that_it_makes_from_the_target_stays(self):
        prediction, target = pair(3, 7, 6)
        target[:, 2:4] = 0.0
        error, mean = l1_loss(prediction, target, own=valid)
        expected = weight_map(target, "legs") * torch.abs(prediction - target) * (target != 0)
        assert torch.allclose(error, expected, atol=1e-6)
        assert torch.allclose(mean, expected.mean(), rtol=1e-5)

    def test_a_batch_reduced_by_image(self):
        prediction, target = pair(4, 3, 7, 6)
        found = l1_loss(prediction, target, own=lambda a, b: torch.abs(a - b).mean(dim=(1, 2, 3)))
        expected = torch.stack([l1_loss(prediction[i], target[i]) for i in range(4)])
        assert torch.allclose(found, expected, rtol=1e-5)

    def test_takes_the_place_of_mask_and_reduction(self):
        for settings in ({"mask": torch.ones(4, 4)}, {"reduction": "none"}):
            with pytest.raises(LegsError, match="without mask= and reduction= beside it"):
                l1_loss(*pair(3, 4, 4), own=F.l1_loss, **settings)

    @pytest.mark.parametrize("name", NO_L1)
    def test_what_is_no_l1_is_refused(self, name):
        prediction, target = pair(3, 7, 6)
        for _ in range(2):  # in every step
            with pytest.raises(LegsError, match=r"own= is no L1: 256 times the difference gives .* times the loss"):
                l1_loss(prediction, target, own=NO_L1[name])
        with torch.no_grad():  # nothing is weighted
            assert torch.equal(l1_loss(prediction, target, own=NO_L1[name]), NO_L1[name](prediction, target))

    def test_one_that_is_weighted_itself_is_weighted_once(self):
        prediction, target = pair(3, 7, 6)
        found = l1_loss(prediction, target, own=lambda a, b: l1_loss(a, b))
        assert torch.allclose(found, l1_loss(prediction, target), rtol=1e-5)

    def test_how_much_it_grows_is_said(self):
        with pytest.raises(LegsError, match="gives 65,536 times the loss"):  # 256 squared
            l1_loss(*pair(3, 7, 6), own=F.mse_loss)

    @pytest.mark.parametrize("name", L1)
    @pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
    def test_what_is_an_l1_is_not(self, name, dtype):
        prediction, target = pair(3, 7, 6)
        l1_loss(prediction.to(dtype), target.to(dtype), own=L1[name])

    def test_one_that_is_chosen_later_is_asked_again(self):
        prediction, target = pair(3, 7, 6)

        def step(criterion):
            return l1_loss(prediction, target, own=lambda a, b: criterion(a, b))

        for criterion in (F.l1_loss, torch.nn.L1Loss(), lambda a, b: (a - b).abs().sum()):
            assert step(criterion) > criterion(prediction, target)
        for criterion in (F.mse_loss, torch.nn.MSELoss(), partial(F.mse_loss, reduction="sum")):
            with pytest.raises(LegsError, match="no L1"):
                step(criterion)

    def test_it_is_asked_once_though_made_anew_in_each_step_and_draws_no_number(self):
        calls = []
        prediction, target = pair(3, 7, 6)

        def step(scale):
            def drawn(a, b):
                calls.append(scale)
                return ((a - b).abs() * (torch.rand(a.shape) > 0.5)).mean() * scale

            return l1_loss(prediction, target, own=lambda a, b: drawn(a, b))

        torch.manual_seed(7)
        found = [step(scale) for scale in (0.8, 0.7, 0.6)]
        assert calls == [0.8, 0.8, 0.8, 0.7, 0.6]
        torch.manual_seed(7)
        assert [step(scale) for scale in (0.8, 0.7, 0.6)] == found

    @pytest.mark.skipif(not hasattr(torch, "func"), reason="this torch has no torch.func")
    @pytest.mark.parametrize("way", WAYS)
    def test_transforms_and_checkpoints_ask_it_too(self, way):
        prediction, target = pair(2, 3, 7, 6)
        WAYS[way](lambda p: l1_loss(p, target[0] if p.dim() == 3 else target, own=F.l1_loss), prediction)
        with pytest.raises(LegsError, match="no L1"):
            WAYS[way](lambda p: l1_loss(p, target[0] if p.dim() == 3 else target, own=F.mse_loss), prediction)

    @pytest.mark.skipif(not hasattr(torch, "compile") or sys.platform == "win32", reason="no torch.compile")
    def test_a_compiled_graph_asks_it_too(self):
        prediction, target = pair(3, 7, 6)
        for own, expected in ((F.l1_loss, l1_loss(prediction, target, own=F.l1_loss)), (F.mse_loss, None)):
            loss = torch.compile(lambda p, t, own=own: l1_loss(p, t, own=own), backend="aot_eager", fullgraph=True)
            if expected is not None:
                torch.testing.assert_close(loss(prediction, target), expected)
                loss(*pair(3, 7, 8)), loss(*pair(3, 6, 9))  # other sizes, symbolic then
            else:
                with pytest.raises(RuntimeError, match="own= is no L1"):
                    loss(prediction, target)


# The codebase's own line, and the line that the patch puts there.
LINES = {
    "own l1_loss": (lambda a, b: torch.abs(a - b).mean(), lambda a, b: l1_loss(a, b)),
    "target first": (lambda a, b: torch.abs(b - a).mean(), lambda a, b: l1_loss(a, b)),
    "F.l1_loss": (lambda a, b: F.l1_loss(a, b), lambda a, b: l1_loss(a, b, own=F.l1_loss)),
    "F.l1_loss, target first": (
        lambda a, b: F.l1_loss(b, a),
        lambda a, b: l1_loss(a, b, own=lambda a, b: F.l1_loss(b, a)),
    ),
    "unreduced": (
        lambda a, b: F.l1_loss(a, b, reduction="none").mean(),
        lambda a, b: l1_loss(a, b, reduction="none").mean(),
    ),
    "a mask on both": (
        lambda a, b: torch.abs(a[..., b[0, 0] > 0.5] - b[..., b[0, 0] > 0.5]).mean(),
        lambda a, b: l1_loss(a, b, reduction="none")[..., b[0, 0] > 0.5].mean(),
    ),
    "masked": (
        lambda a, b: masked(a, b, (b > 0.5).float()),
        lambda a, b: l1_loss(a, b, own=lambda x, y: masked(x, y, (b > 0.5).float())),
    ),
    "a tuple": (lambda a, b: valid(a, b)[1], lambda a, b: l1_loss(a, b, own=valid)[1]),
}


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("off", ["LEGS_OFF", "LEGS_BETA"])
def test_off_is_the_codebase_s_own_line_to_the_last_bit(name, off, monkeypatch):
    monkeypatch.setenv(off, "1" if off == "LEGS_OFF" else "0")
    own, patched = LINES[name]
    for shape in ((3, 7, 5), (3, 33, 47), (1, 3, 50, 21), (3, 101, 103)):
        for dtype in (torch.float32, torch.float64):
            prediction, target = pair(*shape)
            prediction = prediction.detach().to(dtype).requires_grad_(True)
            target = target.to(dtype)
            expected, found = own(prediction, target), patched(prediction, target)
            assert torch.equal(found, expected)
            share = torch.rand((), dtype=dtype)
            assert torch.equal(gradient(share * found, prediction), gradient(share * expected, prediction))
    assert not active()


@pytest.mark.parametrize("name", LINES)
def test_evaluation_is_the_codebase_s_own_line_too(name):
    own, patched = LINES[name]
    prediction, target = pair(3, 9, 8)
    with torch.no_grad():
        assert torch.equal(patched(prediction, target), own(prediction, target))
    assert torch.equal(patched(prediction.detach(), target), own(prediction.detach(), target))


class TestUnweighted:
    """``unweighted(photometric)(a, b)``: one call of a function in which ``l1_loss`` is plain."""

    @pytest.mark.parametrize("name", LINES)
    def test_is_the_codebase_s_own_line_to_the_last_bit(self, name):
        own, patched = LINES[name]
        for shape in ((3, 33, 47), (1, 3, 50, 21)):
            prediction, target = pair(*shape)
            expected, found = own(prediction, target), unweighted(patched)(prediction, target)
            assert torch.equal(found, expected)
            assert torch.equal(gradient(0.3 * found, prediction), gradient(0.3 * expected, prediction))

    def test_ends_with_the_call_and_counts_as_plain(self):
        prediction, target = pair(3, 9, 8)
        weighted, before = l1_loss(prediction, target), counts()
        assert unweighted(l1_loss)(prediction, target) < weighted
        assert torch.equal(l1_loss(prediction, target), weighted)
        after = counts()
        assert (after.plain - before.plain, after.weighted - before.weighted) == (1, 1)

    def test_nests_and_ends_with_an_exception(self):
        prediction, target = pair(3, 9, 8)

        def twice():
            with pytest.raises(LegsError):
                unweighted(l1_loss)(prediction, target, reduction="sum")
            return unweighted(l1_loss)(prediction, target), l1_loss(prediction, target)

        weighted = l1_loss(prediction, target)
        inner, outer = unweighted(twice)()
        assert torch.equal(inner, outer)
        assert inner < weighted
        assert torch.equal(l1_loss(prediction, target), weighted)

    def test_concerns_its_own_thread_alone(self):
        prediction, target = pair(3, 9, 8)
        weighted = l1_loss(prediction, target)
        elsewhere = []

        def meanwhile():
            thread = threading.Thread(target=lambda: elsewhere.append(l1_loss(prediction, target)))
            thread.start()
            thread.join()

        unweighted(meanwhile)()
        assert torch.equal(elsewhere[0], weighted)

    def test_takes_a_module_and_keywords(self):
        class Photometric(torch.nn.Module):
            def forward(self, image, gt_image, share=1.0):
                return share * l1_loss(image, gt_image)

        prediction, target = pair(3, 9, 8)
        found = unweighted(Photometric())(prediction, gt_image=target, share=0.5)
        assert torch.equal(found, 0.5 * torch.abs(prediction - target).mean())

    @pytest.mark.slow
    @pytest.mark.skipif(not hasattr(torch, "compile"), reason="this torch has no torch.compile")
    def test_of_a_compiled_function(self):
        compiled = torch.compile(lambda p, t: l1_loss(p, t))
        prediction, target = pair(3, 16, 16)
        torch.testing.assert_close(compiled(prediction, target), l1_loss(prediction, target))
        torch.testing.assert_close(unweighted(compiled)(prediction, target), torch.abs(prediction - target).mean())
        torch.testing.assert_close(compiled(prediction, target), l1_loss(prediction, target))


class TestLayout:
    def test_a_call_that_contradicts_the_images_is_refused_with_what_to_write(self):
        for shape, said in (((20, 30, 3), False), ((1, 3, 20, 30), True)):
            with pytest.raises(LegsError, match=rf"has its channels \w+: leave channels_last={said} out"):
                l1_loss(*pair(*shape), channels_last=said)

    def test_small_and_feature_images_are_not_mistaken(self):
        for shape, last in (((3, 4, 3), False), ((4, 3, 3), False), ((16, 20, 30), False), ((20, 30, 16), True)):
            assert l1_loss(*pair(*shape), channels_last=last).requires_grad


def test_active_says_whether_anything_is_weighted(monkeypatch):
    assert active()
    configure("3dgs")
    assert not active()
    configure("legs")
    monkeypatch.setenv("LEGS_OFF", "1")
    configure("legs")
    assert not active()
