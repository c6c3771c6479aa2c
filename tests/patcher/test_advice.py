"""Advice is what --site writes: with LEGS_BETA=0 each advised line has the original's value and gradient."""

from __future__ import annotations

import re
import sys
from collections import Counter

import pytest
import torch
import torch.nn.functional as F
from legs_adapters.code.syntax import code
from legs_adapters.plan import plan
from legs_adapters.terms.kinds.masked import Masked
from legs_adapters.terms.text import Text, on_one_line

import legs_loss
from tests.patcher.executing import compare, last_value, names_of
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
LEAST = {"edit": 205, "advice": 22, "mask": 6}
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


def test_a_side_of_numbers_is_no_photograph(tmp_path):
    found = plan(checkout(tmp_path, files("masked_target_weighted_mask_left"))).findings
    of_numbers = [p.advice for p in found.problems if re.search(r"plain|shift|torch\.tensor", p.reason)]
    assert of_numbers == ["leave it: it compares with no photograph"] * 3


@pytest.mark.skipif(sys.version_info < (3, 9), reason="ast.unparse is of Python 3.9")
def test_a_line_that_loses_its_mask_is_found(tmp_path, monkeypatch):
    start_run(monkeypatch, tmp_path)
    monkeypatch.setenv("LEGS_BETA", "0")
    names, sides = {"torch": torch, "legs_loss": legs_loss}, ("image", "gt")
    lines = "(torch.abs(image - gt) * mask).mean()", "legs_loss.l1_loss(image, gt)"
    assert compare(*lines, *sides, names) != "same"
    assert (
        compare(lines[0], "legs_loss.l1_loss(image, gt, own=lambda a, b: (a - b).abs().mean())", *sides, names)
        != "same"
    )
    assert compare("(image - gt).abs().mean()", lines[1], *sides, names) == "same"


def written_lines(name, root):
    """Yield what a case's terms become, (site, original, written, by) by an edit, an advised line or a mask."""
    found = plan(checkout(root, files(name)), **options(name)).findings
    for site in found.sites:
        if isinstance(site.form, Masked):  # changes nothing without masks
            rendering, _, masked = site.form.line.partition(" = ")
            yield site, f"1.0 * {rendering}", f"1.0 * {masked}", "mask"
        else:
            text = Text(found.program.sources[site.path], site.scope)
            yield site, on_one_line(code(site.form.node)), site.form.advice(text, site.writing()), "edit"
    for problem in [*found.problems, *found.doubts]:
        if not problem.by_site:
            continue
        taken = plan(root, by_hand=[(problem.path, problem.line)])
        (site,) = [site for site in taken.findings.sites if (site.path, site.line) == (problem.path, problem.line)]
        assert problem.advice in " ".join(taken.after[problem.path].decode().split())  # what is advised is written
        yield site, on_one_line(code(site.form.node)), problem.advice, "advice"


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info < (3, 9), reason="ast.unparse is of Python 3.9")
def test_every_line_of_the_cases_has_the_value_and_gradient_of_the_original(tmp_path, monkeypatch):
    start_run(monkeypatch, tmp_path)
    monkeypatch.setenv("LEGS_BETA", "0")
    same, wrong = Counter(), []
    for name in NAMES:
        for site, original, written, by in written_lines(name, tmp_path / name):
            with names_of(tmp_path / name, site.path) as names:
                if original.isidentifier() and by == "edit":  # the read of an error map
                    original = last_value(tmp_path / name, site.path, original, site.line)
                first, second = (on_one_line(code(side)) for side in (site.form.first, site.form.second))
                sides = site.writing().ordered(first, second)
                result = compare(original, written, *sides, {**names, "legs_loss": legs_loss})
            same[by] += result == "same"
            wrong += [] if result in ("same", "cannot be run") else [f"{name} {site.path}:{site.line}: {result}"]
    assert wrong == []
    # Of 221 edits, 23 advised lines and 6 masks; the others call what no file of theirs defines.
    assert all(same[by] >= least for by, least in LEAST.items()), same
