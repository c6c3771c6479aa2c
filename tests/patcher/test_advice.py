"""Advice is what --site writes: with LEGS_BETA=0 each advised line has the original's value and gradient."""

from __future__ import annotations

import re

import pytest
import torch
import torch.nn.functional as F
from legs_adapters.plan import plan

import legs_loss
from tests.patcher.support import NAMES, checkout, files, options
from tests.support import start_run

STEP = """import torch
import torch.nn.functional as F
from gaussian_renderer import render


def masked_l1(image, gt, mask, scale=1.0):
    return (torch.abs(image - gt) * mask).mean() * scale


def training(gaussians, cams, net):
    for cam in cams:
        image_a, image_b, mask = net(cam)
        loss = {term}
        loss.backward()
        gaussians.optimizer.step()
"""
TERMS = [
    "torch.abs(image_a - image_b).mean()",
    "(image_b - image_a).abs().mean()",
    "F.l1_loss(image_a, image_b)",
    "F.l1_loss(image_a, image_b, reduction='sum')",
    "masked_l1(image_a, image_b, mask, scale=2.0)",
    "(torch.abs(image_a - image_b) * mask).sum() / mask.sum()",
    "torch.abs(image_a * mask - image_b * mask).mean(dim=0).mean()",
    "torch.nn.L1Loss(reduction='none')(image_a, image_b).sum()",
    "(0.8 * torch.abs(image_a[:, 1:] - image_b[:, 1:])).mean()",
    "((image_a - image_b) * mask).abs().mean()",
]


def masked_l1(image, gt, mask, scale=1.0):
    return (torch.abs(image - gt) * mask).mean() * scale


def value_and_gradient(code):
    """Run a term on random images; return its value and the gradient of the first."""
    generator = torch.Generator().manual_seed(7)
    image_a, image_b = (torch.rand(3, 12, 9, generator=generator) for _ in range(2))
    image_a.requires_grad_()
    mask = (torch.rand(1, 12, 9, generator=generator) > 0.4).float()
    names = dict(torch=torch, F=F, legs_loss=legs_loss, masked_l1=masked_l1)
    loss = eval(code, {**names, "image_a": image_a, "image_b": image_b, "mask": mask})
    loss.backward()
    return loss.detach(), image_a.grad


@pytest.mark.parametrize("term", TERMS)
def test_an_advised_line_has_the_value_and_gradient_of_the_original(term, tmp_path, monkeypatch):
    found = plan(checkout(tmp_path, {"train.py": STEP.replace("{term}", term)}))
    (problem,) = found.findings.problems
    site = ("train.py", problem.line)
    if not problem.by_site:
        assert "(" not in problem.advice  # words
        with pytest.raises(legs_loss.LegsError, match=re.escape(problem.advice)):
            plan(tmp_path, by_hand=[site])
        return
    taken = plan(tmp_path, by_hand=[site])
    line = next(at for at in taken.after["train.py"].decode().splitlines() if at.startswith("        loss = "))
    assert problem.advice in line  # the same code writes both
    start_run(monkeypatch, tmp_path)
    monkeypatch.setenv("LEGS_BETA", "0")
    for one, other in zip(value_and_gradient(term), value_and_gradient(line.partition(" = ")[2])):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-7)


def test_terms_in_words_and_terms_with_a_line_are_both_tried(tmp_path):
    kinds = [plan(checkout(tmp_path / str(n), {"train.py": STEP.replace("{term}", t)})) for n, t in enumerate(TERMS)]
    advised = [problem.by_site for found in kinds for problem in found.findings.problems]
    assert advised.count(True) >= 6
    assert advised.count(False) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith(("_error", "_left"))])
def test_every_advised_line_of_the_cases_is_what_site_writes(name, tmp_path):
    root = checkout(tmp_path, files(name))
    found = plan(root, **options(name)).findings
    for problem in [*found.problems, *found.doubts]:
        if problem.by_site:
            after = plan(root, by_hand=[(problem.path, problem.line)]).after[problem.path].decode()
            assert problem.advice in " ".join(after.split())
