"""Make a COLMAP scene from photographs: camera poses and points of the scene.

PHOTOS is a folder of photographs of one static scene, each overlapping its neighbours. OUT gets the undistorted
photographs in images/ and COLMAP's cameras, poses and points in sparse/0/, as 3DGS, its forks and this package's
commands read them. Needs pycolmap: pip install pycolmap.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

from legs_loss.system.terminal import say

HELP = "make a COLMAP scene from photographs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("photographs", metavar="PHOTOS", type=Path, help="a folder of photographs")
    parser.add_argument("out", metavar="OUT", type=Path, help="the scene's folder, which must not exist yet")
    parser.add_argument(
        "--max_size", type=int, default=3200, metavar="N", help="pixels of the longer side at most; default: 3200"
    )
    parser.add_argument(
        "--overlap",
        type=int,
        metavar="N",
        help="compare each photograph with the N that follow it by name, for frames of a video; default: all with all",
    )
    parser.add_argument("--threads", type=int, default=-1, metavar="N", help="default: one per core")


def run(args: argparse.Namespace) -> int:
    """Write the scene; 1 when the camera of a photograph was not found."""
    from legs_loss.errors import LegsError
    from legs_loss.lab.reconstruct import reconstruct

    for name, fits, wanted in (
        ("max_size", args.max_size >= 64, "at least 64"),
        ("overlap", args.overlap is None or args.overlap >= 1, "at least 1"),
        ("threads", args.threads == -1 or args.threads >= 1, "at least 1"),
    ):
        if not fits:
            raise LegsError(f"--{name} must be {wanted}, got {getattr(args, name)}")

    made = reconstruct(
        args.photographs, args.out, args.max_size, args.overlap, args.threads, partial(say, stream=sys.stderr)
    )
    say(
        f"{made.folder}: {len(made.placed)} of {len(made.placed) + len(made.lost)} photographs, {made.points} points, "
        f"mean reprojection error {made.error:.2f} pixels"
    )
    if made.lost:
        say(f"legs: no camera was found for {', '.join(made.lost)}: they are omitted", sys.stderr)
    return 1 if made.lost else 0
