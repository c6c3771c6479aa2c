"""Measure the effect of blur and noise on the mean weight of a photograph, for docs/evidence.md.

    python docs/evidence/mean_weights.py SCENE docs/evidence/fox_weights.json

One view after the other is degraded, the others of its scene stay sharp; the rows are means over all views. Then
rebuild.py makes the table.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Callable, Dict, List

import torch
from torch import Tensor

from legs_loss.levels import response_levels, scene_levels
from legs_loss.reference.training.degrade import moved
from legs_loss.response import gaussian_blur, response
from legs_loss.scenes import image_tensor, load_training_image, read_scene
from legs_loss.spec import PRESETS
from legs_loss.weights import weight_map

ARMS = ("legs", "legs-robust")
RESOLUTION = 2


def noise(sigma: float) -> Callable[[Tensor], Tensor]:
    """Return a function that adds noise of ``sigma`` of 255 to an image, and rounds it to 8 bits."""

    def noisy(image: Tensor) -> Tensor:
        values = image + sigma / 255 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
        return (values.clamp(0, 1) * 255).round() / 255

    return noisy


DEGRADED: Dict[str, Callable[[Tensor], Tensor]] = {
    "as it is": lambda image: image,
    "blurred, sigma 2": lambda image: gaussian_blur(image, 2.0),
    "blurred, sigma 4": lambda image: gaussian_blur(image, 4.0),
    "moved": moved,
    "noise 5 of 255": noise(5),
    "noise 10 of 255": noise(10),
    "a gray wall with noise 1": lambda image: noise(1)(torch.full_like(image, 0.5)),
}


def measure(root: Path) -> List[Dict[str, object]]:
    """Return a row for each way to degrade a view: the mean weight by preset."""
    views = [image_tensor(load_training_image(view, RESOLUTION)) for view in read_scene(root).views]
    spec = PRESETS["legs-robust"]

    def levels(image: Tensor) -> Tensor:
        return response_levels(response(image, spec.operator, spec.p, smooth=spec.smooth), spec)

    own = [levels(view) for view in views]
    rows = []
    for name, degrade in DEGRADED.items():
        sums = dict.fromkeys(ARMS, 0.0)
        rises = dict.fromkeys(ARMS, 0)
        for index, view in enumerate(views):
            worse = degrade(view)
            scene = scene_levels([*own[:index], levels(worse), *own[index + 1 :]])
            for arm in ARMS:
                mean = float(weight_map(worse, arm, scene=scene).mean())
                sums[arm] += mean
                rises[arm] += mean > float(weight_map(view, arm, scene=scene_levels(own)).mean()) + 1e-6
        rows.append({"photograph": name, "mean": {arm: sums[arm] / len(views) for arm in ARMS}, "rises": rises})
    return rows


if __name__ == "__main__":
    torch.set_num_threads(1)
    scene, out = Path(sys.argv[1]), Path(sys.argv[2])
    measured = {"views": len(read_scene(scene).views), "resolution": RESOLUTION, "rows": measure(scene)}
    out.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
