"""Compute the weight maps of a scene once, for every later training.

SCENE is a folder with a COLMAP model, with transforms.json, or just with images. The maps go to SCENE/legs_weights,
where a training script that is given the scene finds them by itself. Give -r, -w and --images as the training will have
them: a map is used only for the very image that it was made from.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from collections import Counter
from pathlib import PurePosixPath

HELP = "compute the weight maps of a scene once, for every later training"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    parser.add_argument(
        "scene", metavar="SCENE", help="a COLMAP scene, a scene with transforms.json or a folder of images"
    )
    parser.add_argument("--images", metavar="DIR", help='folder of the photographs, in the scene or a path ("images")')
    parser.add_argument(
        "-r",
        "--resolution",
        type=int,
        default=-1,
        metavar="1|2|4|8|WIDTH",
        help="as in 3DGS; default: at most 1600 wide",
    )
    parser.add_argument("-w", "--white_background", action="store_true", help="as in 3DGS: lay alpha over white")
    parser.add_argument("--preset", choices=PRESETS, default="legs", help="whose operator to use; default: legs")
    parser.add_argument(
        "--out", metavar="DIR", help="the store's folder; default: SCENE/legs_weights, where a training finds it"
    )
    parser.add_argument("--workers", type=int, default=_cores(), metavar="N", help="processes; default: one a core")


def run(args: argparse.Namespace) -> int:
    """Write the store; 1 when a photograph was skipped."""
    from legs_loss.cli.checks import check_resolution
    from legs_loss.config import STORE_FOLDER
    from legs_loss.errors import LegsError
    from legs_loss.precompute import precompute
    from legs_loss.scenes import read_scene

    if args.workers < 1:
        raise LegsError(f"--workers must be at least 1, got {args.workers}")
    scene = read_scene(args.scene, args.images)
    check_resolution(args.resolution, scene.views)
    report = precompute(
        scene,
        out=args.out,
        spec=args.preset,
        resolution=args.resolution,
        white_background=args.white_background,
        workers=args.workers,
        progress=True,
    )
    for view, reason in report.skipped.items():
        print(f"legs: skipped {view}: {reason}", file=sys.stderr)
    # 3DGS names a view by its file's name up to the first dot.
    short = Counter(PurePosixPath(view.name).name.split(".")[0] for view in scene.views)
    alike = sum(count for count in short.values() if count > 1)
    if alike:
        print(
            f"legs: note: {alike} views share a name in 3DGS, which knows no folders and no extensions; "
            "code that names views so will compute their weights instead",
            file=sys.stderr,
        )
    print(f"{report.store}: {len(report.made)} made, {len(report.kept)} up to date, {len(report.skipped)} skipped")
    if not report.store.resolve().parent.samefile(scene.root) or report.store.name != STORE_FOLDER:
        print(
            f"legs: note: a training that is given the scene looks in {scene.root / STORE_FOLDER}, not there: name the "
            f"store with LEGS_STORE={shlex.quote(str(report.store.resolve()))}, or as `store` in legs.toml",
            file=sys.stderr,
        )
    return 1 if report.skipped else 0


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
