"""Each kind of photometric term: the example in its docstring is planned, with the result that the docstring states."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re

import pytest
from legs_adapters.plan import plan
from legs_adapters.report import as_table
from legs_adapters.terms import kinds
from legs_adapters.terms.form import Form

from tests.patcher.support import checkout, files

MODULES = [importlib.import_module(f"{kinds.__name__}.{info.name}") for info in pkgutil.iter_modules(kinds.__path__)]
KINDS = sorted(
    {c for m in MODULES for c in vars(m).values() if inspect.isclass(c) and issubclass(c, Form) and c is not Form},
    key=lambda kind: kind.__name__,
)

SCRIPT = """import torch
import torch.nn.functional as F
from gaussian_renderer import render
from scene import Scene
from scene.gaussian_model import GaussianModel
from utils.loss_utils import l1_loss, ssim


def relative(image, gt):
    return (image - gt) / (gt + 0.01)


def robust(residual, c):
    return (residual.abs() / c).mean()


def combined(image, gt, functions):
    return functions[0](image, gt)


def training(dataset, pipe, background):
    gaussians = GaussianModel(3)
    scene = Scene(dataset, gaussians)
    for cam in scene.getTrainCameras():
        image = render(cam, gaussians, pipe, background)["render"]
        gt_image = cam.original_image.cuda()
        {step}
        loss.backward()
        gaussians.optimizer.step()
"""


def example(kind):
    """Return the lines of a kind's example by their labels."""
    return dict(re.findall(r"^ *(before|after|advice): (.+)$", inspect.getdoc(kind), re.M))


def step(code):
    return code.replace("; ", "\n        ")


def planned(tmp_path, code, ssim=False, masks=False):
    name = "ssim_beside_l1_fused" if ssim else "common"
    shared = {path: text for path, text in files(name).items() if path != "train.py"}
    return plan(
        checkout(tmp_path, {**shared, "train.py": SCRIPT.replace("{step}", step(code))}), ssim=ssim, masks=masks
    )


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_the_example_gives_what_the_docstring_says(tmp_path, kind):
    said = example(kind)
    found = planned(tmp_path, said["before"], ssim=kind.term == "ssim", masks=kind.term == "mask")
    if "after" in said:
        assert step(said["after"]) in found.after["train.py"].decode()
    else:
        assert [problem.advice for problem in found.findings.problems] == [said["advice"]]


def test_every_kind_is_found_by_itself():
    assert {kind.__name__ for kind in KINDS} >= {
        "Absolute",
        "Called",
        "Indirect",
        "PassedByName",
        "Reread",
        "Ssim",
    }


@pytest.mark.parametrize(
    ("case", "why"),
    [
        ("l1_function_as_value_weighted", "image and gt_image, the photograph, at train.py:14"),
        ("registered_callable_weighted", "input and target, the photograph"),
    ],
)
def test_what_is_passed_by_name_names_both_sides(case, why, tmp_path):
    found = plan(checkout(tmp_path, files(case)))
    assert f"passed by name, and called with {why}\n" in as_table(found)
