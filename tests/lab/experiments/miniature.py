"""A training codebase of our own in the shape of the public ones, small enough that a comparison takes seconds.

What it trains is a picture a view, not Gaussians; its density control adds a "Gaussian" wherever the gradient of the
loss passes a threshold, so that a larger loss makes more of them, as in the real ones.
"""

from __future__ import annotations

from pathlib import Path

TRAIN = """
import argparse
import os
import random

import numpy as np
import torch
from gaussian_renderer import render
from PIL import Image


def l1_loss(network_output, gt):
    return torch.abs((network_output - gt)).mean()


def ssim(img1, img2):
    mean1, mean2 = (torch.nn.functional.avg_pool2d(img[None], 5, 1) for img in (img1, img2))
    return ((2 * mean1 * mean2 + 0.01) / (mean1**2 + mean2**2 + 0.01)).mean()


class Camera:
    def __init__(self, uid, image):
        self.uid = uid
        self.original_image = image


def load(folder, width):
    views = []
    for name in sorted(os.listdir(folder)):
        image = Image.open(os.path.join(folder, name)).convert("RGB")
        image = image.resize((width, round(width * image.height / image.width)))
        views.append(torch.from_numpy(np.asarray(image, np.float32) / 255.0).permute(2, 0, 1))
    return views


def save(folder, image):
    os.makedirs(os.path.dirname(folder), exist_ok=True)
    Image.fromarray((image.clamp(0, 1) * 255).byte().permute(1, 2, 0).numpy()).save(folder)


def training(args):
    torch.manual_seed(0)
    random.seed(0)
    views = load(os.path.join(args.source_path, "images"), args.resolution)
    train = [view for index, view in enumerate(views) if index % 8]
    pictures = [torch.nn.Parameter(0.5 + 0.1 * torch.randn(view.shape)) for view in train]
    cameras = [Camera(uid, view) for uid, view in enumerate(train)]
    optimizer = torch.optim.Adam(pictures, lr=0.02)
    points = 100
    for iteration in range(1, args.iterations + 1):
        viewpoint_cam = random.choice(cameras)
        image = render(viewpoint_cam, pictures)["render"]
        gt_image = viewpoint_cam.original_image
        Ll1 = l1_loss(image, gt_image)
        loss = 0.8 * Ll1 + 0.2 * (1.0 - ssim(image, gt_image))
        loss.backward()
        gradient = pictures[viewpoint_cam.uid].grad.abs() * image.numel() * (image - gt_image).detach().abs()
        points += int((gradient > args.densify_grad_threshold).sum())
        optimizer.step()
        optimizer.zero_grad()
        if iteration in (7, args.iterations):  # as 3DGS saves at 7000 and at 30000
            cloud = os.path.join(args.model_path, "point_cloud", f"iteration_{iteration}", "point_cloud.ply")
            os.makedirs(os.path.dirname(cloud))
            with open(cloud, "w") as file:
                file.write(f"ply\\nformat ascii 1.0\\nelement vertex {points}\\nend_header\\n")
    torch.save([picture.detach() for picture in pictures], os.path.join(args.model_path, "pictures.pt"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("-s", "--source_path")
    parser.add_argument("-m", "--model_path")
    parser.add_argument("-r", "--resolution", type=int, default=24)
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--densify_grad_threshold", type=float, default=0.2)
    training(parser.parse_args())
"""

RENDERER = """
def render(viewpoint_camera, pc):
    rendered_image = rasterizer(pc, viewpoint_camera)
    return {"render": rendered_image}


def rasterizer(pc, viewpoint_camera):
    return pc[viewpoint_camera.uid].clone()
"""

RENDER = """
import argparse
import os

import torch
from train import load, save

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("-s", "--source_path")
    parser.add_argument("-m", "--model_path")
    parser.add_argument("-r", "--resolution", type=int, default=24)
    args = parser.parse_args()
    pictures = torch.load(os.path.join(args.model_path, "pictures.pt"))
    views = load(os.path.join(args.source_path, "images"), args.resolution)
    for split, truths in (("train", [v for i, v in enumerate(views) if i % 8]), ("test", views[::8])):
        for index, truth in enumerate(truths):
            folder = os.path.join(args.model_path, split, "ours_30")
            save(os.path.join(folder, "renders", f"{index:05d}.png"), pictures[index])
            save(os.path.join(folder, "gt", f"{index:05d}.png"), truth)
"""

PROFILE = """
extends = "3dgs"
name = "miniature"
text = { "train.py" = "densify_grad_threshold" }
train = ["train.py -s {scene} -m {output}"]
shorter = "--iterations {iterations}"
images = ""
render = ["render.py -s SCENE -m {output}"]

[[threshold]]
words = "--densify_grad_threshold {value}"
value = 0.2
"""


def write_miniature(root: Path, scene: Path) -> Path:
    """Write the codebase and its profile; return the profile."""
    root.mkdir()
    (root / "train.py").write_text(TRAIN)
    (root / "render.py").write_text(RENDER)
    (root / "gaussian_renderer.py").write_text(RENDERER)
    profile = root.with_suffix(".toml")
    profile.write_text(PROFILE.replace("SCENE", scene.as_posix()))
    return profile
