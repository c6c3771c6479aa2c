"""Each rule leaves its first example, by a line that decides, and not its second; the documents follow the rules."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from textwrap import dedent, indent

import pytest
from legs_adapters.plan import plan
from legs_adapters.rules.order import RULES
from legs_adapters.rules.rule import Rule

from tests.patcher.support import checkout, files, legs_patch
from tests.support import legs_environment

IMPORTS = """\
import torch
import torch.nn.functional as F
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.loss_utils import l1_loss, ssim


"""
STEP = """\
def training(cameras, gaussians, initial_scaling):
    for camera in cameras:
        package = render(camera, gaussians, None, None)
        image, gt = package["render"], camera.original_image
{}
        loss.backward()
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
"""


def planned(folder, example, ssim=False):
    """Return the plan of a codebase whose train.py is an example, and the example's first and last line in it."""
    text = example if re.match("(import|from) ", example) else IMPORTS + example
    if not re.search("^(import|from|def|class) ", example, re.M):
        text = IMPORTS + STEP.format(indent(example, 8 * " "))
    text += "\n"
    first = text[: text.index(example.splitlines()[0])].count("\n") + 1
    other = IMPORTS + STEP.format("        loss = l1_loss(image, gt)")  # so that no other term has to be the loss
    texts = dict(files("ssim_beside_l1_fused" if ssim else "inria"), **{"train.py": text, "other.py": other})
    return plan(checkout(folder, texts), ssim=ssim), first, first + example.count("\n")


def examples(rule, label):
    """Return the code under a label of a rule's docstring, "skipped" or "weighted"."""
    return [dedent(code).strip() for code in re.findall(rf"^{label}:\n((?:    .*\n)+)", rule.text + "\n", re.M)]


LEFT = [(rule, example) for rule in RULES.values() for example in examples(rule, "skipped")]
WEIGHTED = [(rule, example) for rule in RULES.values() for example in examples(rule, "weighted")]


@pytest.mark.parametrize(("rule", "example"), LEFT, ids=[rule.id for rule, _ in LEFT])
def test_a_rule_leaves_its_invalid_code_and_names_the_line_that_decided(rule, example, tmp_path):
    found, first, last = planned(tmp_path, example, rule.id.startswith("ssim-"))
    left = [entry for entry in found.findings.left if entry.path == "train.py"]
    assert rule.id in [entry.rule for entry in left]
    for entry in left:
        assert entry.reason == RULES[entry.rule].reason
        if entry.rule == rule.id:
            lines = entry.because
            assert lines
            for line in lines:
                assert line.path == "train.py"
                assert first <= line.line <= last or line.text.startswith("def training(")
                assert (tmp_path / line.path).read_text().splitlines()[line.line - 1].strip() == line.text


@pytest.mark.parametrize(("rule", "example"), WEIGHTED, ids=[rule.id for rule, _ in WEIGHTED])
def test_the_valid_code_of_a_rule_is_weighted(rule, example, tmp_path):
    found, first, last = planned(tmp_path, example, rule.id.startswith("ssim-"))
    lines = [site.line for site in found.findings.sites if site.path == "train.py"]
    assert lines
    assert first <= min(lines) <= max(lines) <= last
    assert not [entry for entry in found.findings.left if entry.path == "train.py"]
    assert not found.findings.problems


def test_every_rule_in_the_causes_has_a_place_in_the_order():
    def leaves(kind):
        return [leaf for each in kind.__subclasses__() for leaf in (leaves(each) or [each])]

    assert {type(rule) for rule in RULES.values()} == set(leaves(Rule))
    assert all(rule.id and rule.reason and examples(rule, "skipped") for rule in RULES.values())


def test_the_report_names_the_rule_and_the_line_that_decided(tmp_path):
    root = checkout(tmp_path, files("inria"))
    shown = legs_patch("--check", root).stdout
    why = RULES["evaluation"].sentence().rstrip(".")
    assert f"train.py:32            skipped  {why} (rule evaluation, line 29: with torch.no_grad():)\n" in shown
    left = json.loads(legs_patch("--check", "--json", root).stdout)["left"]
    assert left[0]["rule"] == left[0]["reason"] == "evaluation"
    assert left[0]["because"] == [{"file": "train.py", "line": 29, "code": "with torch.no_grad():"}]


def test_the_condition_that_decides_is_the_one_around_the_term(tmp_path):
    example = (
        "def step(gaussians, camera, tracking):\n"
        "    if tracking:\n"
        "        print('tracking')\n"
        "    image = render(camera, gaussians, None, None)['render']\n"
        "    if tracking and camera.skipped:\n"
        "        return\n"
        "    elif tracking:\n"
        "        l1_loss(image, camera.original_image).backward()\n"
        "        gaussians.optimizer.step()\n"
    )
    found, first, _ = planned(tmp_path, example)
    [left] = [entry for entry in found.findings.left if entry.path == "train.py"]
    assert left.rule == "tracking"
    assert [(line.line - first, line.text) for line in left.because] == [(6, "elif tracking:")]


def test_the_def_that_decides_is_found_below_its_decorators_and_namesakes(tmp_path):
    example = (
        "def evaluate(gaussians, camera):\n"
        "    return None\n\n\n"
        "@torch.jit.ignore\n"
        "async  def evaluate(\n"
        "    gaussians,  # def evaluate(\n"
        "    camera,\n"
        "):\n"
        "    image = render(camera, gaussians, None, None)['render']\n"
        "    return l1_loss(image, camera.original_image)\n"
    )
    found, first, _ = planned(tmp_path, example)
    [left] = [entry for entry in found.findings.left if entry.path == "train.py"]
    assert left.rule == "evaluation"
    assert [(line.line - first, line.text) for line in left.because] == [(5, "async  def evaluate(")]


def test_a_term_outside_of_functions_is_decided_by_its_own_line(tmp_path):
    example = "import torch\nfrom utils.loss_utils import l1_loss\n\nprint(l1_loss(image, gt_image))\n"
    found, _, _ = planned(tmp_path, example)
    [left] = [entry for entry in found.findings.left if entry.path == "train.py"]
    assert left.rule == "untrained"
    assert [line.line for line in left.because] == [4]


def test_a_default_that_decides_is_shown_by_the_def_it_stands_in(tmp_path):
    example = (
        "def step(gaussians, camera, predicted, key='rendered_mask'):\n"
        "    predicted = predicted(camera)\n"
        "    torch.abs(predicted[key] - camera.targets[key]).mean().backward()\n"
        "    gaussians.optimizer.step()\n"
    )
    found, first, _ = planned(tmp_path, example)
    [left] = [entry for entry in found.findings.left if entry.path == "train.py"]
    assert left.rule == "mask"
    assert [line.line for line in left.because] == [first]


def test_the_table_of_reasons_in_the_documents_is_current():
    page = Path(__file__).parents[2] / "docs" / "patching.md"
    assert (
        subprocess.run([sys.executable, page.parent / "reasons.py", "--check"], env=legs_environment()).returncode == 0
    )
    assert all(f"\n| `{name}` | " in page.read_text(encoding="utf-8") for name in RULES)


def test_a_loss_of_modules_in_a_list_is_quoted_and_what_stands_beside_it_is_not(tmp_path):
    texts = {
        "losses.py": """import torch

class ImageLoss(torch.nn.Module):
    def forward(self, prediction, batch, mask):
        delta = prediction.color - batch["image"]
        delta = delta[mask]
        return delta.abs().mean()

class SmoothLoss(torch.nn.Module):
    def forward(self, prediction, batch, mask):
        img = batch["image"]
        return torch.mean(torch.abs(img[..., :-1] - img[..., 1:]), 1, keepdim=True).mean()

class PerceptualLoss(torch.nn.Module):
    def forward(self, pred, target):
        return torch.mean(torch.abs(pred - target))
""",
        "evaluate.py": "def evaluate(model, view):\n    return model.forward(view)\n",
        "train.py": """from gsplat import rasterization

def step(model, losses, batch, mask, optimizer):
    prediction = model.forward(batch)
    loss = sum(loss_fn.forward(prediction, batch, mask) for loss_fn in losses)
    loss.backward()
    optimizer.step()
""",
    }
    shown = json.loads(legs_patch("--check", "--json", checkout(tmp_path, texts)).stdout)
    assert [(problem["file"], problem["line"]) for problem in shown["problems"]] == [("losses.py", 7)]
    assert shown["sites"] == []


def test_what_is_no_loss_of_a_photograph_is_not_quoted_beside_one_that_is(tmp_path):
    texts = {
        "model.py": """import torch
from diff_gaussian_rasterization import GaussianRasterizer

class Diffusion(torch.nn.Module):
    def get_loss(self, pred, target):
        return (target - pred).abs().mean()

    def training_step(self, batch, index):
        volumes, render_images = batch["volume"], batch["images"]
        output = self.denoise(volumes)
        return {"loss": self.get_loss(output, volumes) + self.draw(output, render_images)}

    def draw(self, output, render_images):
        image = self.render(output)
        gt_image = render_images[0]
        return torch.abs(image - gt_image).mean()

def get_loss_tracking_rgb(image, viewpoint):
    return torch.abs(image - viewpoint.original_image).mean()

def check(view, radii):
    return (radii - view.radii).abs().max()
""",
    }
    shown = json.loads(legs_patch("--check", "--json", checkout(tmp_path, texts)).stdout)
    assert [(problem["file"], problem["line"]) for problem in shown["problems"]] == [("model.py", 16)]
    assert shown["sites"] == []
