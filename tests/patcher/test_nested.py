"""The whole way through a framework with a method cloned into it, as the READMEs of NeRFICG and FasterGS say."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.patcher.support import checkout, legs_patch, run_git, snapshot
from tests.support import legs_environment

FRAMEWORK = {
    ".gitignore": "__pycache__/\n",
    "scripts/train.py": """\
import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "src"))

if __name__ == "__main__":
    method = importlib.import_module(f"Methods.{sys.argv[1]}.Trainer")
    print(" ".join(f"{loss:.6f}" for loss in method.train(int(sys.argv[2]))))
""",
    "src/Optim/Losses/Base.py": """\
import torch


class BaseLoss(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.metrics = []

    def add_loss_metric(self, name, metric, weight):
        self.metrics.append((name, metric, weight))

    def forward(self, configurations):
        return sum(weight * metric(**configurations[name]) for name, metric, weight in self.metrics)
""",
}
METHOD = {
    "Loss.py": """\
import torch

from Optim.Losses.Base import BaseLoss


class ThingLoss(BaseLoss):
    def __init__(self):
        super().__init__()
        self.add_loss_metric("L1_Color", torch.nn.functional.l1_loss, 0.8)

    def forward(self, input, target):
        return super().forward({"L1_Color": {"input": input, "target": target}})
""",
    "Trainer.py": """\
import torch

from Methods.{name}.Loss import ThingLoss


def train(steps):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(3, 24, 32, generator=generator)
    gaussians = torch.full((3, 24, 32), 0.5, requires_grad=True)
    optimizer = torch.optim.Adam([gaussians], lr=0.01)
    criterion = ThingLoss()
    for _ in range(steps):
        optimizer.zero_grad()
        loss = criterion(gaussians, target)
        loss.backward()
        optimizer.step()
        yield loss.item()
""",
}


def method(name):
    return {path: text.replace("{name}", name) for path, text in METHOD.items()}


def steps(root, *launcher, name="FasterThing", **variables):
    """Train six steps as a user does, and return what the script printed."""
    command = [sys.executable, *launcher, "scripts/train.py", name, "6"]
    done = subprocess.run(
        command, cwd=str(root), env={**legs_environment(), **variables}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
def test_clone_clone_patch_train_undo(tmp_path):
    inner = {f"src/Methods/Thing/{path}": text for path, text in method("Thing").items()}
    checkout(tmp_path / "upstream" / "framework", {**FRAMEWORK, **inner}, git=True)
    checkout(tmp_path / "upstream" / "method", method("FasterThing"), git=True)
    root = tmp_path / "framework"
    run_git(tmp_path, "clone", "-q", str(tmp_path / "upstream" / "framework"), str(root))
    run_git(root, "clone", "-q", str(tmp_path / "upstream" / "method"), "src/Methods/FasterThing")
    before, plain = snapshot(root), steps(root)

    in_memory = steps(root, "-m", "legs_loss", "run", "--cpu")
    assert snapshot(root) == before
    done = legs_patch(root)
    assert done.returncode == 0, done.stderr
    for path in ("src/Methods/FasterThing/Loss.py", "src/Methods/Thing/Loss.py"):
        assert f"{path}:" in done.stdout
    weighted = steps(root)
    assert weighted == in_memory
    assert len(weighted) == len(plain) == 6
    assert all(float(one) > float(other) for one, other in zip(weighted, plain))  # weights are at least 1
    assert steps(root, LEGS_OFF="1") == plain
    assert steps(root, name="Thing") == weighted

    assert legs_patch("--undo", root).returncode == 0
    assert snapshot(root) == before
    assert steps(root) == plain
