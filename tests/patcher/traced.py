"""A codebase whose loss cannot be read off its text, in variants, with a scene on disk; its line is known by hand."""

from __future__ import annotations

import json
import textwrap

import numpy as np
from PIL import Image

VIEWS, WIDTH, HEIGHT = 6, 48, 32

_MODEL = '''
import math
import torch


class Splats:
    """Round Gaussians in the plane of the picture, a shift a view."""

    def __init__(self, count=150):
        torch.manual_seed(0)
        self.xy = torch.nn.Parameter(torch.rand(count, 2))
        self.colour = torch.nn.Parameter(torch.rand(count, 3))
        self.opacity = torch.nn.Parameter(torch.zeros(count, 1))
        self.optimizer = torch.optim.Adam([
            {"params": [self.xy], "lr": 1e-3, "name": "xy"},
            {"params": [self.colour], "lr": 1e-2, "name": "colour"},
            {"params": [self.opacity], "lr": 1e-2, "name": "opacity"},
        ])

    def draw(self, camera):
        h, w = camera.height, camera.width
        grid = torch.stack(torch.meshgrid(torch.linspace(0, 1, h), torch.linspace(0, 1, w), indexing="ij"), -1)
        shifted = self.xy + camera.pose
        squared = ((grid[:, :, None] - shifted) ** 2).sum(-1)
        blend = torch.softmax(self.opacity[:, 0] - 400 * squared, -1)
        image = (blend @ self.colour).permute(2, 0, 1)
        return {"rgb": image, "depth": (blend @ self.xy[:, :1]).permute(2, 0, 1), "normal": 0.9 * image + 0.05}
'''

_DATA = """
import os
import numpy as np
import torch
from PIL import Image


class Camera:
    def __init__(self, folder, name):
        self.name = name
        self.values = {key: self.read(folder, key, name) for key in ("images", "normals") if
                       os.path.isdir(os.path.join(folder, key))}
        self.height, self.width = self.values["images"].shape[1:]
        self.pose = torch.nn.Parameter(torch.zeros(2))

    def read(self, folder, key, name):
        with Image.open(os.path.join(folder, key, name)) as image:
            return torch.from_numpy(np.array(image.convert("RGB"))).float().permute(2, 0, 1) / 255


def cameras(folder):
    return [Camera(folder, name) for name in sorted(os.listdir(os.path.join(folder, "images")))]
"""

_HEAD = """
import argparse
import torch
import torch.nn.functional as F
from data import cameras
from model import Splats

parser = argparse.ArgumentParser()
parser.add_argument("-s")
views = cameras(parser.parse_known_args()[0].s)
splats = Splats()
"""


def write(folder, train, **more):
    """Write the codebase with a train.py of this body and other files; return the line marked `# <- here`."""
    folder.mkdir()
    train = _HEAD + textwrap.dedent(train)
    files = {"model.py": _MODEL, "data.py": _DATA, "train.py": train, **more}
    found = None
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
        for number, line in enumerate(text.splitlines(), 1):
            if "# <- here" in line:
                found = name, number
    return found


def write_scene(folder, normals=True):
    """Write photographs of smooth random patterns, listed by transforms.json, and normals of other patterns."""
    random = np.random.default_rng(0)
    for name in ["images", *(["normals"] if normals else [])]:
        (folder / name).mkdir(parents=True)
        for view in range(VIEWS):
            small = random.integers(0, 255, (5, 7, 3), dtype=np.uint8)
            Image.fromarray(small).resize((WIDTH, HEIGHT), Image.BICUBIC).save(folder / name / f"{view:03}.png")
    matrix = np.eye(4).tolist()
    frames = [{"file_path": f"images/{view:03}.png", "transform_matrix": matrix} for view in range(VIEWS)]
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.8, "frames": frames}))
    return folder
