"""The arguments of demo and compare: a scene, at a size that a CPU trains in minutes."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING

from legs_loss.cli.shared.scene_arguments import add_images, add_resolution
from legs_loss.system.machine import cores

if TYPE_CHECKING:
    from legs_loss.scenes import Scene

AFFORDABLE = 70_000  # pixels a photograph


def add_scene_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the scene, its photographs and their size, and the number of parallel trainings."""
    parser.add_argument("scene", metavar="SCENE", nargs="?", help="a COLMAP scene; default: the embedded scene")
    add_images(parser)
    add_resolution(parser, f"about {AFFORDABLE:,} pixels, which a CPU trains in minutes")
    parser.add_argument(
        "--processes", type=int, default=cores(), metavar="N", help="trainings at a time; default: one per core"
    )


def default_resolution(scene: Scene) -> int:
    """Return the width that leaves AFFORDABLE pixels, or the photographs' own size (1) where that is less."""
    sizes = [(view.camera.width, view.camera.height) for view in scene.views if view.camera is not None]
    width, height = max(sizes, default=(1, 1))
    return 1 if width * height <= AFFORDABLE else round(width * math.sqrt(AFFORDABLE / (width * height)))
