"""DataLoader workers by spawn, which import the training script again: the loss in it, and a store read in them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from legs_loss.precompute import precompute
from legs_loss.scenes import read_scene
from tests.support import colmap_scene, legs_environment

TRAIN = """
import sys
from pathlib import Path

import numpy as np
import torch

import legs_loss
import legs_loss.runtime
from legs_loss.scenes import View, image_tensor, load_training_image
from legs_loss.store import WeightStore

scene = Path(sys.argv[1])


class Views(torch.utils.data.Dataset):
    def __init__(self):
        self.names = sorted(path.name for path in (scene / "images").iterdir())
        self.store = WeightStore(scene / "legs_weights")  # pickled, for each worker

    def __len__(self):
        return len(self.names)

    def __getitem__(self, index):
        image = image_tensor(load_training_image(View("a", scene / "images" / self.names[index])))
        spec = legs_loss.WeightSpec()
        entry = self.store.find(self.names[index], *image.shape[1:], spec)
        loss = legs_loss.l1_loss(torch.zeros_like(image).requires_grad_(), image)  # counted in the worker, not here
        return index, image, self.store.weight(entry, spec), loss.item()


if __name__ == "__main__":
    loader = torch.utils.data.DataLoader(
        Views(), batch_size=1, num_workers=2, multiprocessing_context="spawn", persistent_workers=True
    )
    legs_loss.configure(store=scene / "legs_weights")
    for epoch in range(2):
        for index, image, weight, theirs in loader:
            image = image[0]
            mine = legs_loss.l1_loss(torch.zeros_like(image).requires_grad_(), image)
            by_hand = (weight[0] * image.mean(0)).mean()
            assert abs(float(mine - by_hand)) < 1e-6 * float(by_hand), (float(mine), float(by_hand))
            assert abs(float(theirs) - float(mine)) < 2e-3 * float(mine)  # computed there, from float16 here
    counts = legs_loss.runtime.counts()
    print(counts.weighted, counts.plain, counts.stored, counts.remembered, counts.computed)
"""


@pytest.mark.slow
def test_spawned_and_persistent(tmp_path):
    """The parent counts its own steps alone, and says its first and last line once."""
    scene = colmap_scene(tmp_path / "scene", names=[f"{number}.png" for number in range(5)])
    precompute(read_scene(scene))
    (tmp_path / "train.py").write_text(TRAIN)
    done = subprocess.run(
        [sys.executable, "train.py", str(scene)],
        cwd=str(tmp_path),
        env=legs_environment(),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == "10 0 5 5 0\n"  # the second epoch remembers, done.stderr
    assert done.stderr.count("10 step(s) weighted") == 1, done.stderr
