"""Measure what a mask of the object does to 3DGS's loss: train inside masks, and score inside them.

    python object_masks.py SCENE OUT -r 180 --iterations 1000 --seeds 3 --arm corrected
    python object_masks.py --report OUT/rows.json OTHER/rows.json

The object is a ball around the point that the cameras look at, so large that it covers a fifth of the photographs on
average; its outline in each photograph is the mask. The loss is 3DGS's, by the package's trainer, which takes the masks
from a store. PSNR and SSIM are means over the pixels of the mask; LPIPS is that of the rendering with the photograph
outside. `--arm` only names the rows: run it by two versions of the package to compare them.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Sequence, Tuple

import numpy as np
import torch
from PIL import Image

from legs_loss.lab.experiments.statistics import pooled_difference
from legs_loss.lab.training import TrainConfig, train
from legs_loss.lab.training.dataset import TrainingView, load_dataset
from legs_loss.lab.training.metrics import mean_scores, psnr
from legs_loss.lab.training.perceptual import has_lpips, lpips, use_lpips
from legs_loss.lab.training.trainer import draw
from legs_loss.scenes import Camera, Scene, read_scene
from legs_loss.similarity import ssim_map

SHARE = 0.2  # of a photograph, on average
SCORES = {"psnr": ".2f", "ssim": ".4f", "lpips": ".4f"}


def main() -> None:
    """Train what is missing, or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="a COLMAP capture; with --report a file of rows")
    parser.add_argument("out", type=Path, nargs="*")
    parser.add_argument("-r", "--resolution", type=int, default=180)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--arm", default="masked")
    parser.add_argument("--lpips", type=Path, metavar="WEIGHTS")
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args()
    if args.report:
        report([args.scene, *args.out])
        return
    (out,) = args.out
    use_lpips(args.lpips)
    masked = out / "scene"
    if not masked.is_dir():
        shares = make_scene(read_scene(args.scene), masked, args.resolution)
        (out / "shares.json").write_text(json.dumps(shares))
    shares = json.loads((out / "shares.json").read_text())
    path = out / "rows.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    for seed in range(len(rows), args.seeds):
        config = TrainConfig(spec="3dgs", iterations=args.iterations, resolution=args.resolution, seed=seed)
        result = train(read_scene(masked), config, out / f"seed-{seed}", resume=None)
        data = load_dataset(read_scene(masked), config.weights, config.resolution)
        views = {
            split: {view.name: scores(draw(result.gaussians, view, config), view) for view in chosen}
            for split, chosen in (("train", data.train), ("test", data.test))
        }
        metrics = {split: mean_scores(list(found.values())) for split, found in views.items()}
        row = dict(arm=args.arm, seed=seed, scene=args.scene.name, iterations=args.iterations, shares=shares)
        row["resolution"] = args.resolution
        rows.append({**row, "metrics": {**metrics, "gaussians": len(result.gaussians.means), "views": views}})
        path.write_text(json.dumps(rows) + "\n")
        print(args.arm, seed, metrics, len(result.gaussians.means), flush=True)


def make_scene(scene: Scene, out: Path, resolution: int) -> Tuple[float, float, float]:
    """Write a scene with a store of masks beside links to its files; return the least, mean and greatest share."""
    cameras = [camera for camera in (view.camera for view in scene.views) if camera is not None]
    places = np.stack([np.linalg.inv(camera.world_to_camera) for camera in cameras])
    centre = nearest_point(places[:, :3, 3], places[:, :3, 2])
    low, high = 0.0, float(np.linalg.norm(places[:, :3, 3] - centre, axis=1).min())
    for _ in range(30):
        radius = (low + high) / 2
        mean = np.mean([outline(camera, centre, radius, 8).mean() for camera in cameras])
        low, high = (radius, high) if mean < SHARE else (low, radius)
    part = out.with_name("scene.part")
    (part / "masks").mkdir(parents=True)
    shares = []
    for view, camera in zip(scene.views, cameras):
        mask = outline(camera, centre, radius, 1)
        shares.append(float(mask.mean()))
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(part / "masks" / f"{Path(view.name).stem}.png")
    for path in scene.root.iterdir():
        if path.name not in ("masks", "legs_weights"):
            (part / path.name).symlink_to(path.resolve())
    os.replace(part, out)
    words = ["precompute", str(out), "--masks", "masks", "-r", str(resolution), "--preset", "3dgs"]
    subprocess.run([sys.executable, "-m", "legs_loss", *words], check=True)
    return min(shares), sum(shares) / len(shares), max(shares)


def nearest_point(places: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the point with the least sum of squared distances from the lines through [N, 3] along unit [N, 3].

    >>> nearest_point(np.array([[0.0, 0, -1], [-1, 0, 0]]), np.array([[0.0, 0, 1], [1, 0, 0]]))
    array([0., 0., 0.])
    """
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    return np.linalg.solve(across.sum(0), (across @ places[:, :, None]).sum(0))[:, 0]


def outline(camera: Camera, centre: np.ndarray, radius: float, every: int) -> np.ndarray:
    """Return which pixels see a ball, bool, of every n-th row and column."""
    y, x = np.mgrid[0 : camera.height : every, 0 : camera.width : every] + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    to = camera.world_to_camera[:3, :3] @ centre + camera.world_to_camera[:3, 3]
    along = rays @ to
    return (along > 0) & (to @ to - along**2 / (rays**2).sum(-1) <= radius**2)


def scores(image: torch.Tensor, view: TrainingView) -> Dict[str, float]:
    """Return the scores of a rendering inside a view's mask."""
    inside = view.hidden(image.clamp(0.0, 1.0))
    assert view.counts is not None
    similarity = ssim_map(inside, view.image)
    return {
        "psnr": psnr(inside, view.image, view.counts),
        "ssim": float(similarity.reshape(-1, *view.counts.shape)[:, view.counts].mean()),
        **({"lpips": lpips(inside, view.image)} if has_lpips() else {}),
    }


def report(paths: Sequence[Path]) -> None:
    """Print a table: every score of the arms, and the last less the first with 95% intervals over seeds and views."""
    files = [json.loads(path.read_text()) for path in paths]
    rows: List[Dict[str, Any]] = [row for file in files for row in file]
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    print("|".join(["", "capture", "split", "score", *arms, f"{arms[-1]} − {arms[0]}", "Gaussians", ""]))
    print(f"|---|---|---|{'---:|' * (len(arms) + 2)}")
    for scene in dict.fromkeys(row["scene"] for row in rows):
        some = [row for row in rows if row["scene"] == scene]
        numbers = [np.mean([row["metrics"]["gaussians"] for row in some if row["arm"] == arm]) for arm in arms]
        for split, name in (("train", "train"), ("test", "held-out")):
            for key, form in SCORES.items():
                if key not in some[0]["metrics"][split]:
                    continue
                means = [np.mean([row["metrics"][split][key] for row in some if row["arm"] == arm]) for arm in arms]
                one = pooled_difference([some], arms[-1], arms[0], split, key)
                cell = f"{one.mean:+{form}} [{one.low:+{form}}, {one.high:+{form}}]" if one else ""
                of = ", ".join(f"{number:,.0f}" for number in numbers)
                print("|".join(["", scene, name, key.upper(), *(f"{mean:{form}}" for mean in means), cell, of, ""]))


if __name__ == "__main__":
    main()
