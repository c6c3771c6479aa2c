"""The trainer's optimiser against torch's Adam, and density control by hand."""

from __future__ import annotations

import math
from typing import List

import pytest
import torch

from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.training.adam import COLOUR_RATE, FIELDS, RATES, Adam, position_rate, select
from legs_loss.lab.training.densify import Schedule, densify, prunable

pytest.importorskip("numba")


pytestmark = pytest.mark.usefixtures("one_thread")


def gaussians_of(scales: List[List[float]], opacity: float = 0.5, sh: int = 4) -> Gaussians:
    count = len(scales)
    return Gaussians(
        means=torch.arange(3.0 * count).reshape(count, 3),
        log_scales=torch.tensor(scales).log(),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        opacity_logits=torch.full((count, 1), math.log(opacity / (1 - opacity))),
        sh=torch.randn(count, sh, 3),
    )


def test_adam_is_torchs_adam_with_3dgs_rates() -> None:
    start = gaussians_of([[0.1, 0.2, 0.3]] * 400)
    ours = Adam(start)
    theirs = {name: getattr(start, name).clone() for name in ("means", *RATES)}
    theirs.update(dc=start.sh[:, :1].clone(), rest=start.sh[:, 1:].clone())
    rates = {**RATES, "means": 1.0, "dc": COLOUR_RATE, "rest": COLOUR_RATE / 20}
    groups = [{"params": [value.requires_grad_()], "lr": rates[name]} for name, value in theirs.items()]
    adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    for iteration in range(5):
        adam.param_groups[0]["lr"] = position_rate(iteration / 5, extent=2.0)
        for name in FIELDS:
            gradient = torch.randn_like(getattr(start, name)) * 10.0 ** -(iteration + 3)
            gradient[::7] = 0.0
            getattr(ours.gaussians, name).grad = gradient
            if name == "sh":
                theirs["dc"].grad, theirs["rest"].grad = gradient[:, :1].clone(), gradient[:, 1:].clone()
            else:
                theirs[name].grad = gradient.clone()
        ours.step(adam.param_groups[0]["lr"])
        adam.step()
    result = {name: getattr(ours.gaussians, name) for name in ("means", *RATES)}
    result.update(dc=ours.gaussians.sh[:, :1], rest=ours.gaussians.sh[:, 1:])
    for name, value in result.items():
        torch.testing.assert_close(value, theirs[name], rtol=1e-5, atol=1e-6, msg=name)
    assert torch.equal(ours.gaussians.means[0], start.means[0])  # never had a gradient: never moved


def test_a_sparse_step_is_the_whole_step_where_it_is_taken_and_nothing_elsewhere() -> None:
    start = gaussians_of([[0.1, 0.2, 0.3]] * 21)
    sparse, whole = (Adam(select(start, torch.arange(21))) for _ in range(2))
    seen = torch.tensor([0, 3, 4, 5, 13, 20])
    others = torch.tensor([i for i in range(21) if i not in seen])
    for _ in range(3):
        for name in FIELDS:
            gradient = torch.randn_like(getattr(whole.gaussians, name))
            for adam in (sparse, whole):
                getattr(adam.gaussians, name).grad = gradient.clone()
        sparse.step(0.1, seen)
        whole.step(0.1)
    for name in FIELDS:
        for ours, theirs in ((sparse.gaussians, whole.gaussians), (sparse.moment2, whole.moment2)):
            assert torch.equal(getattr(ours, name)[seen], getattr(theirs, name)[seen]), name
        assert torch.equal(getattr(sparse.gaussians, name)[others], getattr(start, name)[others]), name
        assert not getattr(sparse.moment1, name)[others].any(), name


def test_moments_follow_their_gaussians() -> None:
    adam = Adam(gaussians_of([[1.0] * 3] * 3))
    for name in FIELDS:
        parameter = getattr(adam.gaussians, name)
        parameter.grad = torch.arange(3.0).reshape(3, *[1] * (parameter.dim() - 1)).expand_as(parameter).contiguous()
    adam.step(0.0)
    adam.replace(torch.tensor([2, 0]), gaussians_of([[2.0] * 3]))
    assert len(adam.gaussians) == 3
    torch.testing.assert_close(adam.moment1.means[:, 0], torch.tensor([0.2, 0.0, 0.0]))
    torch.testing.assert_close(adam.moment2.sh[:, 1, 1], torch.tensor([0.004, 0.0, 0.0]))
    assert all(getattr(adam.gaussians, name).requires_grad and getattr(adam.gaussians, name).is_leaf for name in FIELDS)


def test_an_opacity_reset_lowers_and_never_raises() -> None:
    adam = Adam(gaussians_of([[1.0] * 3] * 2))
    with torch.no_grad():
        adam.gaussians.opacity_logits[0] = -7.0
    adam.moment1.opacity_logits.fill_(1.0)
    adam.reset_opacity(0.01)
    torch.testing.assert_close(adam.gaussians.opacities[:, 0], torch.tensor([math.exp(-7) / (1 + math.exp(-7)), 0.01]))
    assert not adam.moment1.opacity_logits.any()


def test_small_ones_are_cloned_and_large_ones_split() -> None:
    """Extent 10: up to a scale of 0.1 a Gaussian is cloned. Below the threshold nothing happens."""
    before = gaussians_of([[0.05] * 3, [0.3, 0.01, 0.01], [0.3] * 3, [0.1, 0.1, 0.01]])
    gradient = torch.tensor([5e-4, 6e-4, 4.9e-4, 1.0])
    change = densify(before, gradient, 5e-4, 10.0, torch.Generator().manual_seed(0))
    assert change.kept.tolist() == [0, 2, 3]
    assert len(change.new) == 4
    for index, source in ((0, 0), (1, 3)):  # clones are equal to their sources
        for name in FIELDS:
            assert torch.equal(getattr(change.new, name)[index], getattr(before, name)[source])
    for index in (2, 3):  # children of number 1
        torch.testing.assert_close(change.new.scales[index], torch.tensor([0.3, 0.01, 0.01]) / 1.6)
        for name in ("quaternions", "opacity_logits", "sh"):
            assert torch.equal(getattr(change.new, name)[index], getattr(before, name)[1])
    assert not torch.equal(change.new.means[2], change.new.means[3])


def test_children_are_drawn_from_their_parent() -> None:
    """A needle along its own x axis, turned by 90 degrees about z: its children spread along y."""
    many = gaussians_of([[2.0, 0.5, 0.02]] * 4000)
    many.means.zero_()
    many.quaternions[:] = torch.tensor([3.0, 0.0, 0.0, 3.0])  # any length
    change = densify(many, torch.ones(4000), 0.5, 1.0, torch.Generator().manual_seed(0))
    assert len(change.kept) == 0
    assert len(change.new) == 8000
    torch.testing.assert_close(change.new.means.std(0), torch.tensor([0.5, 2.0, 0.02]), rtol=0.05, atol=0)
    torch.testing.assert_close(change.new.means.mean(0), torch.zeros(3), rtol=0, atol=0.1)


def test_a_cap_lets_the_largest_gradients_through() -> None:
    before = gaussians_of([[0.05] * 3, [0.3] * 3, [0.05] * 3, [0.05] * 3])
    gradient = torch.tensor([3.0, 2.0, 4.0, 1.0])
    for cap, kept, new in (
        (6, [0, 1, 2, 3], [2, 0]),
        (4, [0, 1, 2, 3], []),
        (2, [0, 1, 2, 3], []),
        (7, [0, 2, 3], None),
    ):
        change = densify(before, gradient, 0.5, 10.0, torch.Generator().manual_seed(0), cap)
        assert change.kept.tolist() == kept
        assert len(change.kept) + len(change.new) == max(cap, 4)
        if new is not None:
            assert sorted(change.new.means[:, 0].tolist()) == sorted(3.0 * index for index in new)


def test_transparent_ones_are_pruned_and_later_too_wide_ones() -> None:
    gaussians = gaussians_of([[0.5] * 3, [1.5, 0.1, 0.1], [0.5] * 3])
    gaussians.opacity_logits[2] = math.log(0.0049 / 0.9951)
    assert prunable(gaussians, 10.0, large_too=False).tolist() == [False, False, True]
    assert prunable(gaussians, 10.0, large_too=True).tolist() == [False, True, True]


def test_the_schedule_of_a_short_run() -> None:
    schedule = Schedule.of_run(400)
    assert [i for i in range(1, 401) if schedule.densifies(i)] == [60, 80, 100, 120, 140, 160, 180, 200, 220]
    assert not any(schedule.resets(i) for i in range(1, 401))
    assert [i for i in range(1, 30001) if Schedule.of_run(30000).resets(i)] == [3000, 6000, 9000, 12000]
    for iterations in (1, 2, 3, 10):
        Schedule.of_run(iterations)
