"""Much of everything: steps and photographs, files of a checkout, frames of a scene."""

from __future__ import annotations

import json
import resource
import subprocess
import sys

import pytest

from tests.patcher.support import SITE, checkout, files, legs_patch, snapshot
from tests.support import legs, legs_environment, photograph, save

STEPS = """
import json, sys, time
import torch, legs_loss
import legs_loss.runtime

resident = lambda: int(open("/proc/self/statm").read().split()[1]) * 4096

torch.set_num_threads(1)
steps, images, parts = (int(word) for word in sys.argv[1:])
targets = torch.rand(images, 3, 12, 16, generator=torch.Generator().manual_seed(0))
image = torch.rand(3, 12, 16, requires_grad=True)
seconds, sizes = [], []
order = torch.randperm(steps, generator=torch.Generator().manual_seed(1)) % images
for part in range(parts):
    began = time.process_time()
    for index in order[part * steps // parts : (part + 1) * steps // parts].tolist():
        image.grad = None
        legs_loss.l1_loss(image, targets[index]).backward()
    seconds.append(time.process_time() - began)
    sizes.append(resident())
exact = (legs_loss.weight_map(targets[index]) * (image - targets[index]).abs()).mean()
counts = legs_loss.runtime.counts()
print(json.dumps([seconds, sizes, counts.weighted, counts.plain, counts.computed + counts.remembered,
                  abs(exact.item() - legs_loss.l1_loss(image, targets[index]).item()) < 1e-5]))
"""


@pytest.mark.slow
def test_memory_and_cost_are_flat(tmp_path):
    """Some 14 s of CPU."""
    steps, images, parts = 100_000, 10_000, 10
    done = subprocess.run(
        [sys.executable, "-c", STEPS, str(steps), str(images), str(parts)],
        cwd=str(tmp_path), env=legs_environment(), capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    seconds, sizes, weighted, plain, maps, right = json.loads(done.stdout)
    assert (weighted, plain, maps, right) == (steps, 0, steps, True)
    assert max(sizes[1:]) - sizes[1] < 4 << 20, sizes
    assert min(seconds[-4:]) < 1.3 * min(seconds[:4]), seconds
    assert f"{steps + 1} step(s) weighted" in done.stderr


HELPER = """import torch
from utils.loss_utils import l1_loss


def helper_{0}(x, y):
    total = 0
    for k in range(10):
        total = total + x * k - y
    return total


class Thing{0}:
    def step(self, a):
        return helper_{0}(a, {0})
"""


def megabytes():
    """Return the most memory that a child process had so far."""
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss >> 10


@pytest.mark.slow
def test_a_checkout_of_3000_files(tmp_path):
    """Some 15 s of CPU and 230 MB a command: each of its 301 trainings is weighted, and undone."""
    theirs = files("inria")
    names = {i: f"package{i // 60}/folder{i % 7}/module{i}.py" for i in range(3000)}
    texts = {name: theirs["train.py"] if i % 10 == 0 else HELPER.format(i) for i, name in names.items()}
    root = checkout(tmp_path / "many", {**theirs, **texts})
    before = snapshot(root)
    done = legs_patch(root)
    assert done.returncode == 0, done.stderr
    after = snapshot(root)
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"train.py", *(name for i, name in names.items() if i % 10 == 0)}
    assert all(SITE.encode() not in after[name] and b"legs_loss.l1_loss(" in after[name] for name in changed)
    assert legs_patch("--undo", root).returncode == 0
    assert snapshot(root) == before
    assert megabytes() < 2000


@pytest.mark.slow
def test_a_scene_of_100000_frames(tmp_path):
    """Some 20 s of CPU and 470 MB; what is missing is said for the first of them, and counted."""
    names = [f"images/{number:06}.png" for number in range(100_000)]
    pose = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    frames = [{"file_path": name, "transform_matrix": pose} for name in names]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "w": 8, "h": 6, "frames": frames}))
    for name in names[:3]:
        save(tmp_path / name, photograph(8, 6))
    done = legs("info", tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr[:2000]
    assert "has 100000 photograph(s) and no weight maps yet" in done.stderr
    done = legs("masks", tmp_path, "--from", "dark")
    assert done.returncode == 1
    assert done.stdout.endswith(": 3 masks, 99997 skipped\n")
    said = [line for line in done.stderr.splitlines() if "skipped" in line]
    assert len(said) == 21 and said[-1] == "legs: skipped 99,977 more"
    assert megabytes() < 2000
