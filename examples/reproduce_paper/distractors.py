"""Measure what masks are worth: train a codebase on photographs with a distractor, plain and masked, and on clean ones.

    python distractors.py SCENE OUT --upstream CHECKOUT --resolution 200 --iterations 1000 --seeds 3

A textured patch moves over every third training view. Held-out views are as they were. `plain` trains on that, `masked`
with the patches' masks by `legs-patch --masks`, `clean` on the photographs without patches: the upper bound. All three
have the codebase's own loss (beta 0) and run in the same way, on the CPU. Given again, it goes on where it stopped.
`--arms robust robust-clean` trains with a mask that the training makes by itself (robust.py), on the scenes of `plain`
and `clean`.
OUT/scores.json has a row a training; `--report FILE ...` prints the tables of such files.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
from PIL import Image, ImageFilter

from legs_loss.lab.experiments.statistics import pooled_difference
from legs_loss.lab.training.dataset import load_view, split_views
from legs_loss.lab.training.metrics import mean_scores, score
from legs_loss.scenes import read_scene

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the repository
from examples.reproduce_paper.codebases.profile import find_profile
from examples.reproduce_paper.codebases.training import (
    Checkout,
    copy_checkout,
    gaussians_in,
    read_picture,
)

ARMS = ("plain", "masked", "clean")
SCENES = {**{arm: arm for arm in ARMS}, "robust": "plain", "robust-clean": "clean"}  # of all arms
PART = 0.6  # of the square root of the photograph's area: the side of the patch, which covers a quarter of it
MARGIN = 3  # pixels of a mask beyond its patch, at the training's size


def main() -> None:
    """Train what is missing, or print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path, help="a COLMAP capture; with --report a file of scores")
    parser.add_argument("out", type=Path, nargs="*")
    parser.add_argument("--upstream", type=Path, help="a checkout of 3DGS, FastGS or a fork")
    parser.add_argument("-r", "--resolution", type=int, default=200)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--arms", nargs="+", choices=SCENES, default=ARMS)
    parser.add_argument("--robust", type=json.loads, default={}, metavar="JSON", help="other settings than robust.py's")
    parser.add_argument("--report", action="store_true")
    args = parser.parse_args()
    if args.report:
        report([args.scene, *args.out])
        return
    (out,) = args.out
    out = out.resolve()
    if not (out / "scenes").is_dir():
        make_scenes(args.scene, out / "scenes.part", args.resolution)
        os.replace(out / "scenes.part", out / "scenes")
    profile = find_profile(args.upstream)
    for arm in args.arms:
        copy = out / "checkouts" / arm
        if not copy.is_dir():
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy_checkout(args.upstream, copy)
            if arm not in ("plain", "clean"):
                legs("patch", "--masks", str(copy))
    path = out / "scores.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    for seed in range(args.seeds):
        for arm in args.arms:
            if any((row["arm"], row["seed"]) == (arm, seed) for row in rows):
                continue
            checkout = Checkout(
                out / "checkouts" / arm,
                profile,
                out / "scenes" / SCENES[arm],
                None,
                args.resolution,
                args.iterations,
                cpu=True,
            )
            row = dict(arm=arm, seed=seed, scene=args.scene.name, codebase=profile.name, iterations=args.iterations)
            robust = args.robust if arm.startswith("robust") else None
            rows.append({**row, "metrics": train(checkout, seed, out / arm / f"seed-{seed}", robust)})
            path.write_text(json.dumps(rows, indent=1) + "\n")
            metrics = rows[-1]["metrics"]
            print(arm, seed, metrics["test"]["psnr"], metrics["gaussians"], metrics["counts"], flush=True)


def make_scenes(scene: Path, out: Path, resolution: int) -> None:
    """Write the three arms' scenes: photographs, the reconstruction, and for `masked` the maps of its masks."""
    read = read_scene(scene)
    training = sorted(view.name for view in split_views(read)[0])
    hidden = training[::3]
    shutil.rmtree(out, ignore_errors=True)
    for arm in ARMS:
        (out / arm / "images").mkdir(parents=True)
        shutil.copytree(scene / "sparse", out / arm / "sparse")
    (out / "masked" / "masks").mkdir()
    for view in read.views:
        name = Path(view.name).name
        with Image.open(view.path) as image:
            photograph = image.convert("RGB")
        with_patch, mask = photograph, None
        if view.name in hidden:
            with_patch, mask = distract(photograph, hidden.index(view.name) / max(len(hidden) - 1, 1), resolution)
        for arm in ARMS:
            (photograph if arm == "clean" else with_patch).save(out / arm / "images" / name, quality=98)
        if mask is not None:
            mask.save(out / "masked" / "masks" / f"{name}.png")
    legs("precompute", str(out / "masked"), "--masks", "masks", "-r", str(resolution), "--preset", "3dgs")


def distract(photograph: Image.Image, at: float, resolution: int) -> Tuple[Image.Image, Image.Image]:
    """Return a photograph with the patch where it is at a time in [0, 1], and the mask: black on the patch.

    The patch is a disc of coloured checks that crosses the picture from left to right in a wave.
    """
    width, height = photograph.size
    side = int(PART * (width * height) ** 0.5)
    cell = np.indices((side, side)) * 12 // side
    colours = np.random.default_rng(7).integers(30, 256, (13, 13, 3), dtype=np.uint8)
    patch = Image.fromarray(colours[cell[0], cell[1]])
    y, x = np.indices((side, side)) - (side - 1) / 2
    disc = Image.fromarray(np.where(x * x + y * y <= (side / 2) ** 2, 255, 0).astype(np.uint8))
    corner = int(at * (width - side)), int((height - side) * (0.5 + 0.4 * np.sin(7 * at)))
    with_patch = photograph.copy()
    with_patch.paste(patch, corner, disc)
    covered = Image.new("L", photograph.size, 0)
    covered.paste(disc, corner)
    margin = 2 * round(MARGIN * width / resolution) + 1
    return with_patch, covered.filter(ImageFilter.MaxFilter(margin)).point(lambda value: 255 - value)


def train(checkout: Checkout, seed: int, folder: Path, robust: Optional[Dict[str, Any]] = None) -> Dict[str, Any]:
    """Train and draw by the codebase's own scripts; score against the photographs without patches.

    With settings of a RobustMask the training leaves out what that does.
    """
    output = folder / "output"
    shutil.rmtree(output, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    words = [] if robust is None else ["--robust", json.dumps(robust)]
    counts = run(checkout, checkout.commands(output, 1.0), seed, folder, "train", words)
    run(checkout, checkout.drawing(output, output), seed, folder, "render")
    clean = read_scene(checkout.scene.with_name("clean"))
    views: Dict[str, Dict[str, Any]] = {}
    for split, photographs in zip(("train", "test"), split_views(clean)):
        drawn = sorted(newest(output, checkout.profile.renders[split]).glob("*.png"))
        truths = [load_view(clean, view, checkout.resolution or -1).image for view in photographs]
        assert len(drawn) == len(truths), (drawn, len(truths))
        views[split] = {path.name: score(read_picture(path), truth, split) for path, truth in zip(drawn, truths)}
    return {
        **{split: mean_scores(list(scores.values())) for split, scores in views.items()},
        "gaussians": gaussians_in(newest(output, checkout.profile.cloud)),
        "counts": counts,
        "views": views,
    }


def run(
    checkout: Checkout,
    commands: Sequence[Sequence[str]],
    seed: int,
    folder: Path,
    step: str,
    robust: Sequence[str] = (),
) -> Dict[str, Any]:
    """Run a step's commands; return the last one's counts."""
    report = folder / f"{step}.json"
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(LEGS_PRESET="3dgs", PYTHONPATH=os.pathsep.join(path for path in sys.path if path))
    if step == "train" and checkout.scene.name == "masked":
        environment.update(LEGS_MASKS="require")
    for words in commands:
        launch = [str(Path(__file__).with_name("launch.py")), str(report), str(seed), *robust, "--cpu", "--ssim"]
        with open(folder / f"{step}.log", "ab") as log:
            subprocess.run(
                [sys.executable, *launch, *words],
                cwd=checkout.root,
                env=environment,
                stdout=log,
                stderr=log,
                check=True,
            )
    return json.loads(report.read_text())


def newest(folder: Path, pattern: str) -> Path:
    """Return the path of the last iteration that a pattern finds."""
    return max(folder.glob(pattern), key=lambda path: [int(part) for part in re.findall(r"\d+", str(path))])


def legs(*words: str) -> None:
    """Run a command of this package."""
    subprocess.run([sys.executable, "-m", "legs_loss", *words], check=True)


def report(paths: Sequence[Path]) -> None:
    """Print tables: each arm's held-out PSNR and Gaussians, and differences with 95% intervals over seeds, views."""
    rows = [row for path in paths for row in json.loads(path.read_text())]
    table(rows, ARMS, (("masked", "plain"), ("masked", "clean"), ("plain", "clean")))
    robust = {(row["codebase"], row["scene"]) for row in rows if row["arm"] == "robust"}
    if robust:
        print()
        some = [row for row in rows if (row["codebase"], row["scene"]) in robust]
        table(some, ("robust", "robust-clean"), (("robust", "plain"), ("masked", "plain"), ("robust-clean", "clean")))


def table(rows: List[Dict[str, Any]], arms: Sequence[str], pairs: Sequence[Tuple[str, str]]) -> None:
    """Print a table of these arms and differences."""
    print("|".join(["", "codebase", "capture", *arms, *map(" - ".join, pairs), "Gaussians", ""]))
    print(f"|---|---|{'---:|' * (len(arms) + len(pairs) + 1)}")
    for name in sorted({row["codebase"] for row in rows}):
        of_name = [row for row in rows if row["codebase"] == name]
        captures = [
            [row for row in of_name if row["scene"] == scene] for scene in sorted({r["scene"] for r in of_name})
        ]
        for capture in captures:
            metrics = [[row["metrics"] for row in capture if row["arm"] == arm] for arm in arms]
            psnr = [np.array([one["test"]["psnr"] for one in arm]) for arm in metrics]
            cells = [f"{v.mean():.2f}" + (f" ± {v.std(ddof=1):.2f}" if len(v) > 1 else "") for v in psnr]
            numbers = ", ".join(f"{np.mean([one['gaussians'] for one in arm]):,.0f}" for arm in metrics)
            print("|".join(["", name, capture[0]["scene"], *cells, *differences([capture], pairs), numbers, ""]))
        print("|".join(["", name, "all", *([""] * len(arms)), *differences(captures, pairs), "", ""]))


def differences(captures: Sequence[List[Dict[str, Any]]], pairs: Sequence[Tuple[str, str]]) -> List[str]:
    """Return by how much arms differ in held-out PSNR, in dB with the intervals."""
    found = [pooled_difference(captures, *pair) for pair in pairs]
    return [f"{one.mean:+.2f} [{one.low:+.2f}, {one.high:+.2f}]" if one else "" for one in found]


if __name__ == "__main__":
    main()
