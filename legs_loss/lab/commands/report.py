"""Make one self-contained HTML page of a comparison, which needs no network.

It has a sortable table of scores; PSNR by iterations and by Gaussians; for some views a slider between two methods,
error and weight maps, and the places where two methods differ most; and all settings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from legs_loss.system.terminal import say

HELP = "write a comparison as one HTML page"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("folder", metavar="RUN", type=Path, help="the folder that legs compare wrote")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: RUN/report.html")
    parser.add_argument("--views", nargs="+", metavar="NAME", help="or parts of names; default: three held-out views")
    parser.add_argument("--arms", nargs="+", metavar="ARM", help="default: all that are trained")
    parser.add_argument("--scene", type=Path, metavar="DIR", help="the scene's folder, if it was moved")


def run(args: argparse.Namespace) -> int:
    """Write the page and print where it is."""
    from legs_loss.errors import require

    require("legs report", "report", "numba", "matplotlib", "jinja2")
    from legs_loss.lab.report.html import write_report

    path = write_report(args.folder, args.output or args.folder / "report.html", args.views, args.arms, args.scene)
    say(f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0
