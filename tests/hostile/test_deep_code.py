"""Code that is deep or large: the plan goes on, and what was not read is reported."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("libcst")

from tests.patching_support import checkout, files
from tests.support import legs_environment

TRAIN = """import torch
from gaussian_renderer import render
from utils.loss_utils import l1_loss


def training(scene, gaussians):
    for cam in scene.getTrainCameras():
        image = render(cam, gaussians, None, None)["render"]
        loss = l1_loss(image, cam.original_image.cuda())
        loss.backward()
"""
# What stands in another function of the checkout, and why that file is reported as unread, if it is.
CASES = {
    "a sum of 400 parts": ("x = " + " + ".join(["l1_loss(a, b)"] * 400), ""),
    "a sum of 2,000 parts": ("x = " + " + ".join(["l1_loss(a, b)"] * 2000), ""),
    "a string of 400 parts": ("x = " + " ".join(["'l1_loss'"] * 400), ""),
    "400 elif": ("if a == 0:\n    x = 0\n" + "".join(f"elif a == {i}:\n    x = {i}\n" for i in range(1, 400)), ""),
    "1,000 attributes": ("x = a" + ".b" * 1000, ""),
    "1,000 not": ("x = " + "not " * 1000 + "a", ""),
    "100 brackets": ("x = " + "[" * 100 + "]" * 100, ""),
    "190 brackets": ("x = " + "[" * 190 + "]" * 190, "brackets are nested more than 150 deep"),
    "2,000 parentheses": ("x = " + "(" * 2000 + "1" + ")" * 2000, "brackets are nested more than 150 deep"),
    "100,000 open ones": ("x = " + "(" * 100_000, "brackets are nested more than 150 deep"),
    "brackets in a string": ("x = '" + ") (" * 400 + "'", ""),
    "5 MB of literal": ("x = [" + "1.25, " * 900_000 + "]", "larger than 2 MiB"),
    "a double byte order mark": ("\ufeff\ufeffl1_loss(a, b)", "cannot be written back exactly"),
}


@pytest.mark.parametrize("name", CASES)
def test_the_training_is_planned_beside_it(tmp_path, name):
    text, why = CASES[name]
    shared = {path: content for path, content in files("common").items() if path != "train.py"}
    other = text + "\n" if name.startswith("a double") else f"from utils.loss_utils import l1_loss\n{text}\n"
    root = checkout(tmp_path, {**shared, "train.py": TRAIN, "other.py": other})
    done = subprocess.run(
        [sys.executable, "-m", "legs_adapters.cli", "--check", str(root)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=legs_environment(),
        timeout=300,
    )
    said = done.stdout.decode()
    assert done.returncode == 1, said
    assert "Traceback" not in said
    assert "would change: train.py" in said
    unread = [line for line in said.splitlines() if line.startswith("other.py ") and "not read" in line]
    assert [why] * bool(why) == [why for line in unread if why in line], said
