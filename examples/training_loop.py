"""A training loop in the shape of 3DGS's train.py, with the one line that gives it the LEGS loss.

    python examples/training_loop.py [SCENE] [--iterations N]

It fits Gaussians to a scene with the CPU rasterizer and torch's own Adam, without densification, so that nothing but
the loop is in the way. Without SCENE it draws itself a small one. `legs train` is the trainer for real use.
"""

from __future__ import annotations

import argparse
import random
import tempfile

import torch

from legs_loss import l1_loss, ssim  # <- the one line: in place of `from utils.loss_utils import l1_loss, ssim`
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.rasterizer import rasterize
from legs_loss.lab.training.dataset import load_dataset
from legs_loss.scenes import read_scene
from legs_loss.spec import PRESETS

RATES = {"means": 2e-3, "log_scales": 5e-3, "quaternions": 1e-3, "opacity_logits": 0.05, "sh": 2.5e-3}


def main() -> None:
    """Train, printing loss and PSNR as it goes."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--iterations", type=int, default=200)
    args = parser.parse_args()
    random.seed(0)
    scene = read_scene(args.scene or write_embedded_scene(tempfile.mkdtemp(), views=12, width=160, height=120))
    cameras = load_dataset(scene, PRESETS["3dgs"], resolution=160).train  # photographs alone: the loss makes the maps

    gaussians = Gaussians.from_points(scene.points.xyz, scene.points.rgb, sh_degree=0)
    parameters = {name: getattr(gaussians, name).requires_grad_() for name in RATES}
    optimizer = torch.optim.Adam([{"params": [parameters[name]], "lr": lr} for name, lr in RATES.items()], eps=1e-15)

    for iteration in range(1, args.iterations + 1):
        viewpoint_cam = random.choice(cameras)
        image, _ = rasterize(
            gaussians.means,
            gaussians.scales,
            gaussians.quaternions,
            gaussians.opacities,
            gaussians.sh,
            viewpoint_cam.camera,
            background=(0.0, 0.0, 0.0),
            sh_degree=0,
        )
        gt_image = viewpoint_cam.image
        Ll1 = l1_loss(image, gt_image)
        loss = (1.0 - 0.2) * Ll1 + 0.2 * (1.0 - ssim(image, gt_image))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        if iteration % 50 == 0 or iteration == args.iterations:
            with torch.no_grad():  # here l1_loss is the plain mean, as every report before it
                psnr = -10 * torch.log10((image - gt_image).square().mean())
                print(f"{iteration:5d}  loss {loss.item():.4f}  L1 {l1_loss(image, gt_image):.4f}  PSNR {psnr:.2f} dB")


if __name__ == "__main__":
    main()
