"""The lines that a run says of itself: swapped images are an error; the first training step, the end."""

from __future__ import annotations

import os
import sys

import pytest
import torch

from legs_loss import LegsError, LEGSLoss, configure, l1_loss, legs_loss, ssim, unweighted, weight_map, weighted_l1
from legs_loss.config import find_config
from tests.preloaded import run
from tests.runtime.support import pair, plain
from tests.support import legs_environment

COMPILES = pytest.mark.skipif(not hasattr(torch, "compile"), reason="this torch has no torch.compile")


def compiled(image, target):
    """The drop-in in a compiled graph; torch.compile is imported where it is used: that takes a second."""
    return torch.compile(l1_loss)(image, target)


class TestSwapped:
    @pytest.mark.parametrize(
        "loss", [l1_loss, legs_loss, LEGSLoss(), LEGSLoss("legs-l"), pytest.param(compiled, marks=COMPILES)]
    )
    def test_a_photograph_in_the_renderings_place_stops(self, loss):
        image, target = pair(3, 9, 8)
        with pytest.raises(LegsError, match="turn them round"):
            loss(target, image)

    @pytest.mark.parametrize("loss", [l1_loss, legs_loss, LEGSLoss()])
    def test_a_photograph_that_is_learned_beside_the_rendering_is_none(self, loss):
        image, target = pair(3, 9, 8)
        exposure = torch.ones(1, requires_grad=True)
        loss(image, exposure * target).backward()
        assert image.grad is not None and image.grad.abs().sum() > 0

    @pytest.mark.parametrize("loss", [l1_loss, legs_loss, LEGSLoss()])
    def test_without_gradients_there_is_none(self, loss):
        image, target = pair(3, 9, 8)
        with torch.no_grad():
            assert torch.isfinite(loss(target, image))

    def test_what_does_not_depend_on_the_order_is_computed(self, monkeypatch):
        image, target = pair(3, 16, 15)
        weight = weight_map(target)
        expected = (weight * (image - target).abs()).mean()
        torch.testing.assert_close(weighted_l1(target, image, weight), expected)
        torch.testing.assert_close(ssim(target, image), ssim(image, target))
        torch.testing.assert_close(legs_loss(target, image, "3dgs"), legs_loss(image, target, "3dgs"))
        torch.testing.assert_close(legs_loss(target, image, weight=weight), legs_loss(image, target, weight=weight))
        torch.testing.assert_close(legs_loss(target, image, lambda_dssim=1.0), 1.0 - ssim(image, target))
        assert torch.equal(unweighted(l1_loss)(target, image), plain(target, image))
        configure("3dgs")
        assert torch.equal(l1_loss(target, image), plain(target, image))


TRAIN = """
import torch
import legs_loss
image, target = torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8)
optimizer = torch.optim.SGD([image], 0.1)
for step in range(3):
    loss = {loss}
    loss.backward()
    optimizer.step()
with torch.no_grad():
    legs_loss.l1_loss(image, target)
"""
EVALUATE = """
import torch
from legs_loss import l1_loss
model, target = torch.nn.Linear(4, 4), torch.rand(3, 8, 4)
with torch.no_grad():
    l1_loss(model(target), target)
"""
FORKED = """
import multiprocessing, os, sys, torch
from legs_loss import l1_loss
Process = multiprocessing.get_context("fork").Process
def train(steps):
    image, target = torch.rand(3, 9, 8, requires_grad=True), torch.rand(3, 9, 8)
    optimizer = torch.optim.SGD([image], 0.1)
    for step in range(steps):
        l1_loss(image, target).backward()
        optimizer.step()
train(2)
child = ({child}){start}
for process in multiprocessing.active_children():
    process.join()
{wait}
"""
GROUP = """
import torch, torch.distributed
torch.distributed.is_available = torch.distributed.is_initialized = lambda: True
torch.distributed.get_rank = lambda: 1
"""
ACTIVE = "L1 weighted, preset legs: laplacian, C3, beta 10; weights computed from the training images; settings from "
BETA = ", beta 0; settings from environment variable "


def said(code: str, folder, **variables: str):
    """The lines on stderr of a process that runs a script."""
    command = [sys.executable, "-c", code]
    done = run(command, cwd=folder, env={**legs_environment(), **variables})
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    return done.stderr.splitlines()


class TestALineAtEachEnd:
    @pytest.mark.parametrize(
        ("variables", "first", "last"),
        [
            ({}, ACTIVE + "defaults", "3 step(s) weighted, 0 plain with a gradient"),
            ({"LEGS_OFF": "1"}, "L1 plain: LEGS_OFF=1", None),
            ({"LEGS_BETA": "0"}, f"L1 plain: preset legs{BETA}LEGS_BETA", None),
            ({"LEGS_PRESET": "3dgs"}, f"L1 plain: preset 3dgs{BETA}LEGS_PRESET", None),
        ],
        ids=lambda value: str(value)[:12],
    )  # fmt: skip
    def test_of_l1_loss(self, tmp_path, variables, first, last):
        code = TRAIN.format(loss="legs_loss.l1_loss(image, target)")
        last = last or "no L1 was weighted in this run: 3 plain step(s) with a gradient"
        assert said(code, tmp_path, **variables) == [f"legs-loss: {first}", f"legs-loss: {last}"]
        assert said(code, tmp_path, RANK="1", **variables) == []

    @pytest.mark.parametrize(
        ("loss", "first", "steps"),
        [
            ("legs_loss.legs_loss(image, target)", "L1 weighted: laplacian, C3, beta 10, by legs_loss", 3),
            ("legs_loss.LEGSLoss()(image, target)", "L1 weighted: laplacian, C3, beta 10, by legs_loss", 3),
            ("legs_loss.legs_loss(image, target, '3dgs')", "L1 plain: beta 0, or no weight is given", 0),
            ("legs_loss.weighted_l1(image, target, legs_loss.weight_map(target))",
             "L1 weighted: the map given to weighted_l1", 3),
        ],
    )  # fmt: skip
    def test_of_the_other_losses(self, tmp_path, loss, first, steps):
        plain = "no L1 was weighted in this run: 3 plain step(s) with a gradient"
        last = f"{steps} step(s) weighted, 0 plain with a gradient" if steps else plain
        assert said(TRAIN.format(loss=loss), tmp_path) == [f"legs-loss: {first}", f"legs-loss: {last}"]

    def test_a_step_that_is_refused_is_none(self, tmp_path):
        refused = [
            "legs_loss.l1_loss(image, target, own=lambda a, b: ((a - b) ** 2).mean())",
            "legs_loss.l1_loss(image, target / 0)",
            "legs_loss.l1_loss(image, target, reduction='none', mask=torch.ones(2, 2))",
            "legs_loss.unweighted(legs_loss.l1_loss)(image, target[:2])",
            "legs_loss.legs_loss(image, target / 0)",
            "legs_loss.LEGSLoss(padding='none')(image, target)",
            "legs_loss.weighted_l1(image, target[:2], torch.ones(9, 8))",
        ]
        attempt = (
            "    try:\n        {}\n        print('not refused')\n    except (ValueError, RuntimeError):\n        pass\n"
        )
        tries = "".join(map(attempt.format, refused))
        code = TRAIN.format(loss="(image - target).abs().mean()").replace(
            "    loss.backward()", f"{tries}    loss.backward()"
        )
        assert said(code, tmp_path) == ["legs-loss: no L1 was weighted in this run"]
        last = "legs-loss: 3 step(s) weighted, 0 plain with a gradient"
        weighted = code.replace("(image - target).abs().mean()\n", "legs_loss.l1_loss(image, target)\n", 1)
        assert said(weighted, tmp_path) == [f"legs-loss: {ACTIVE}defaults", last]

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
    @pytest.mark.parametrize(
        ("child", "theirs"),
        [
            ("Process(target=train, args=(3,))", ["3"]),  # multiprocessing runs no atexit in it
            ("Process(target=str)", []),  # as a worker of a DataLoader
            ("os.fork() or (train(3), sys.exit())", ["3"]),
            ("os.fork() or sys.exit()", []),
        ],
    )
    def test_a_forked_process_counts_its_own_steps(self, tmp_path, child, theirs):
        start, wait = ("", "os.wait()") if "os.fork" in child else (".start()", "")
        code = FORKED.format(child=child, start=start, wait=wait)
        lines = [line for line in said(code, tmp_path) if "settings from" not in line]
        assert lines == [f"legs-loss: {n} step(s) weighted, 0 plain with a gradient" for n in (*theirs, "2")]

    def test_a_rank_that_has_left_its_group_says_nothing(self, tmp_path):
        code = TRAIN.format(loss="legs_loss.l1_loss(image, target)").replace("import torch\n", GROUP, 1)
        assert said(code + "torch.distributed.is_initialized = lambda: False\n", tmp_path) == []

    def test_of_a_training_that_calls_none_and_of_an_evaluation(self, tmp_path):
        code = TRAIN.format(loss="(image - target).abs().mean()")
        assert said(code, tmp_path) == ["legs-loss: no L1 was weighted in this run"]
        assert said(EVALUATE, tmp_path) == []


class TestNamed:
    @pytest.mark.parametrize("kind", [torch.uint8, torch.int64, torch.bool, torch.complex64])
    def test_types_that_are_no_floats(self, kind):
        image = torch.zeros(3, 8, 8, dtype=kind)
        with pytest.raises(LegsError, match=f"prediction is of type {kind}: give floats"):
            l1_loss(image, image)
        if kind in (torch.bool, torch.complex64):
            with pytest.raises(LegsError, match="prediction is of type"):
                l1_loss(image, torch.zeros(3, 8, 8))

    def test_a_variable_for_lambda_names_lambda_s_own_setting(self):
        (note,) = find_config(environ={"LEGS_LAMBDA": "0.3"}, argv=[]).notes
        assert note.endswith("the codebase's own setting, in 3DGS --lambda_dssim") and "LEGS_BETA" not in note
