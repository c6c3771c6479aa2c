"""Several processes: torchrun on gloo, spawned trainings, DataLoader workers; each a real run of a small codebase."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch

from legs_loss.system.terminal import is_first_process
from tests.patcher.support import checkout
from tests.support import colmap_scene, legs, legs_environment

LOSS = """\
import torch


def l1_loss(network_output, gt):
    return torch.abs((network_output - gt)).mean()
"""
SCENE = """\
import os

import numpy as np
import torch
from PIL import Image
from torch.utils.data import Dataset


class Camera:
    def __init__(self, image_name, image):
        self.image_name = image_name
        self.original_image = image


class Scene(Dataset):
    def __init__(self, source_path):
        self.folder = os.path.join(source_path, "images")
        self.names = sorted(os.listdir(self.folder))

    def __len__(self):
        return len(self.names)

    def __getitem__(self, index):
        pixels = np.array(Image.open(os.path.join(self.folder, self.names[index])).convert("RGB"))
        image = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
        return Camera(self.names[index].split(".")[0], image)
"""
RENDERER = """\
import torch


class Gaussians(torch.nn.Module):
    # One image for all views, which every view sees shifted by its number.

    def __init__(self, height, width):
        super().__init__()
        self.image = torch.nn.Parameter(torch.linspace(0, 1, 3 * height * width).reshape(3, height, width))

    def forward(self, viewpoint_cam):
        return self.image.roll(int(viewpoint_cam.image_name), 2)


def render(viewpoint_cam, gaussians):
    return {"render": gaussians(viewpoint_cam)}
"""
TRAIN = """\
import argparse
import json
import os

import torch
import torch.distributed as dist
from gaussian_renderer import Gaussians, render
from scene import Scene
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader
from utils.loss_utils import l1_loss


def training(args):
    dist.init_process_group("gloo")
    rank, world = dist.get_rank(), dist.get_world_size()
    scene = Scene(args.source_path)
    gaussians = Gaussians(*scene[0].original_image.shape[1:])
    optimizer = torch.optim.SGD(gaussians.parameters(), lr=1.0)
    render_all = DistributedDataParallel(gaussians)
    loader = DataLoader(
        scene,
        batch_size=None,
        sampler=range(rank, len(scene), world),
        num_workers=args.workers,
        multiprocessing_context=args.context or None,
    )
    for epoch in range(2):
        for number, viewpoint_cam in enumerate(loader, 1):
            image = render(viewpoint_cam, render_all)["render"]
            gt_image = viewpoint_cam.original_image
            Ll1 = l1_loss(image, gt_image)
            loss = Ll1 / args.views
            loss.backward()
            if number % args.views == 0:
                optimizer.step()
                optimizer.zero_grad()
    report(args.out, rank, gaussians)
    dist.destroy_process_group()  # else a thread of gloo's may end the process


def report(out, rank, gaussians):
    from legs_loss.runtime import counts

    found = {"counts": vars(counts()), "image": gaussians.image.tolist()}
    with open(os.path.join(out, f"{rank}.json"), "w") as file:
        json.dump(found, file)


def parse():
    parser = argparse.ArgumentParser()
    parser.add_argument("--port")
    parser.add_argument("-s", "--source_path")
    parser.add_argument("--out")
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--context", default="")
    return parser.parse_args()


if __name__ == "__main__":
    training(parse())
"""
SPAWNED = """\
import os
import sys

import torch.multiprocessing as mp
from train import parse, training


def work(rank, args):
    os.environ.update(RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=args.port)
    training(args)


if __name__ == "__main__":
    mp.spawn(work, nprocs=2, args=(parse(),))
"""


@pytest.fixture(scope="module")
def codebase(tmp_path_factory):
    """A checkout that patches cleanly, its patched copy, and a scene whose four views have stored maps."""
    if not torch.distributed.is_available():
        pytest.skip("torch was built without torch.distributed")
    folder = tmp_path_factory.mktemp("distributed")
    texts = {
        "train.py": TRAIN, "spawned.py": SPAWNED, "gaussian_renderer.py": RENDERER, "scene/__init__.py": SCENE,
        "utils/__init__.py": "", "utils/loss_utils.py": LOSS,
    }  # fmt: skip
    for name in ("plain", "patched"):
        checkout(folder / name, texts)
    scene = colmap_scene(folder / "views", tuple(f"{number:04d}.png" for number in range(4)))
    assert legs("precompute", scene).returncode == 0
    command = [sys.executable, "-m", "legs_adapters.cli", str(folder / "patched")]
    done = subprocess.run(command, capture_output=True, text=True, env=legs_environment())
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


def run(codebase, kind, script, processes, *arguments, torchrun=True):
    """Run a script; return each rank's report, and the stderr of all of them."""
    out = Path(tempfile.mkdtemp(dir=str(codebase)))
    launch = ["-m", "torch.distributed.run", "--nproc_per_node", str(processes), "--master_port", free_port()]
    program = [script] if kind == "patched" else ["-m", "legs_loss", "run", script]
    command = [
        sys.executable,
        *(launch if torchrun else []),
        *program,
        "-s",
        str(codebase / "views"),
        "--out",
        str(out),
    ]
    done = subprocess.run(
        [*command, *arguments], cwd=str(codebase / kind), env=legs_environment(), capture_output=True, text=True,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [json.loads((out / f"{rank}.json").read_text()) for rank in range(processes)]
    return [torch.tensor(each["image"]) for each in found], [each["counts"] for each in found], done.stderr


@pytest.fixture(scope="module")
def alone(codebase):
    """Train in one process with both ranks' views in each step."""
    images, (counts,), _ = run(codebase, "plain", "train.py", 1, "--views", "2")
    assert (counts["weighted"], counts["stored"], counts["computed"]) == (8, 4, 0)
    return images[0]


@pytest.mark.slow
class TestTorchrun:
    def test_ranks_agree_with_each_other_and_with_one_process(self, codebase, alone):
        for kind in ("plain", "patched"):
            images, counted, said = run(codebase, kind, "train.py", 2)
            assert torch.equal(*images)
            # The gradients of two ranks with a view each are averaged; one process has the mean of both views.
            torch.testing.assert_close(images[0], alone, rtol=0, atol=1e-6)
            for counts in counted:  # two views a rank, each shown twice, from the store
                expected = {"weighted": 4, "plain": 0, "remembered": 2, "stored": 2, "computed": 0}
                assert {name: counts[name] for name in expected} == expected
            assert said.count("L1 weighted, preset legs") == 1
            assert said.count("train.py:32 is weighted in this run") == (kind == "plain")

    @pytest.mark.parametrize("context", ["fork", "spawn"])
    def test_workers_that_load_photographs(self, codebase, alone, context):
        for kind in ("plain", "patched"):
            images, counted, said = run(codebase, kind, "train.py", 2, "--workers", "1", "--context", context)
            assert torch.equal(*images)
            torch.testing.assert_close(images[0], alone, rtol=0, atol=1e-6)
            assert [counts["stored"] for counts in counted] == [2, 2]
            assert said.count("L1 weighted") == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "patched"])
def test_a_training_that_spawns_its_ranks(codebase, kind):
    images, counted, said = run(codebase, kind, "spawned.py", 2, "--port", free_port(), torchrun=False)
    assert torch.equal(*images)
    assert [counts["weighted"] for counts in counted] == [4, 4]
    assert said.count("L1 weighted") == 1


def test_the_first_process_is_rank_0(monkeypatch):
    assert not torch.distributed.is_available() or not torch.distributed.is_initialized()
    for rank in ("0", "", "00", "abc", "-1", "1", "10"):  # what is no number is another program's variable
        monkeypatch.setenv("RANK", rank)
        assert is_first_process() is (rank not in ("1", "10"))
    monkeypatch.delenv("RANK")
    assert is_first_process()
