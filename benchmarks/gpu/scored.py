"""Draw all views of a trained FastGS in the working folder by its own renderer, and score them.

python scored.py REPORT [--cpu] MODEL [WEIGHTS of LPIPS]
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any, Dict


def main(report: str, *words: str) -> None:
    """Write means and scores by view, of the renderings before they are rounded to 8 bits."""
    if words[0] == "--cpu":
        from legs_adapters.shims import start

        words = words[1:]
        start(Path.cwd())
    sys.path.insert(0, os.getcwd())
    model, weights = words
    import torch
    from arguments import ModelParams, PipelineParams, get_combined_args  # type: ignore[import-not-found]
    from gaussian_renderer import render_fastgs  # type: ignore[import-not-found]
    from scene import Scene  # type: ignore[import-not-found]
    from scene.gaussian_model import GaussianModel  # type: ignore[import-not-found]

    from legs_loss import ssim
    from legs_loss.lab.training.metrics import mean_scores, psnr, strongest
    from legs_loss.lab.training.perceptual import has_lpips, lpips, use_lpips

    use_lpips(Path(weights) if weights else None)
    parser = argparse.ArgumentParser()
    groups = ModelParams(parser, sentinel=True), PipelineParams(parser)
    parser.add_argument("--mult", type=float, default=0.5)
    sys.argv = ["render.py", "-m", model]
    args = get_combined_args(parser)
    dataset, pipeline = (group.extract(args) for group in groups)
    views: Dict[str, Dict[str, Dict[str, float]]] = {"train": {}, "test": {}}
    with torch.no_grad():
        gaussians = GaussianModel(dataset.sh_degree, optimizer_type="default")
        scene = Scene(dataset, gaussians, load_iteration=-1, shuffle=False)
        black = torch.zeros(3, device="cuda")
        for split, cameras in (("train", scene.getTrainCameras()), ("test", scene.getTestCameras())):
            for camera in cameras:
                drawn: Any = render_fastgs(camera, gaussians, pipeline, black, args.mult)["render"]
                image, truth = drawn.clamp(0.0, 1.0), camera.original_image[:3].to(drawn.device)
                strong = strongest(truth.cpu()).to(drawn.device)
                views[split][camera.image_name] = {
                    "psnr": psnr(image, truth),
                    "ssim": float(ssim(image, truth)),
                    "psnr_strong": psnr(image, truth, strong),
                    **({"lpips": lpips(image, truth)} if has_lpips() else {}),
                }
    found = {
        **{split: mean_scores(list(scores.values())) for split, scores in views.items()},
        "gaussians": len(gaussians.get_xyz),
        "views": views,
    }
    Path(report).write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    del sys.path[0]
    main(*sys.argv[1:])
