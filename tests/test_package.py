"""The package's public face: every name is there, and costs its import only when it is asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import legs_loss
from tests.support import ROOT, legs_environment


def run(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=legs_environment(),
        cwd=str(ROOT),
    )
    text = done.stdout.decode()
    assert done.returncode == 0, text
    return text


def test_every_public_name_is_there() -> None:
    everything: dict = {}
    exec("from legs_loss import *", everything)
    assert set(legs_loss.__all__) <= set(everything) & set(dir(legs_loss))
    assert sorted(legs_loss._HOMES) == sorted(legs_loss.__all__)
    with pytest.raises(AttributeError, match="module 'legs_loss' has no attribute 'l2_loss'"):
        legs_loss.l2_loss  # noqa: B018


def test_no_module_has_the_name_of_a_function() -> None:
    modules = {path.stem for path in Path(legs_loss.__file__).parent.iterdir()}
    assert modules.isdisjoint(legs_loss.__all__)


def test_patching_does_not_wait_for_torch(tmp_path: Path) -> None:
    script = tmp_path / "train.py"
    script.write_text(
        "import torch\nfrom gaussian_renderer import render\nfrom utils.loss_utils import l1_loss\n\n\n"
        "def training(scene, gaussians):\n    for cam in scene:\n        image = render(cam, gaussians)['render']\n"
        "        loss = l1_loss(image, cam.original_image.cuda())\n        loss.backward()\n"
    )
    run(
        "import sys\n"
        "sys.modules['torch'] = sys.modules['numpy'] = None  # importing them fails\n"
        "from legs_adapters.cli import main\n"
        "assert main(sys.argv[1:]) == 0\n",
        str(tmp_path),
    )
    assert "legs_loss.l1_loss(image" in script.read_text()
