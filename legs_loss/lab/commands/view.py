"""View trained Gaussians in the browser.

Give a .ply of 3DGS, the output folder of a training (of legs train, 3DGS or its forks), a folder of several, as legs
demo writes, or a comparison. Methods can be switched on and off, and two compared with a slider; with a scene, its
cameras are shown with their photographs or weight maps. Colours do not depend on the direction (degree 0).
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from legs_loss.cli.shared.scene_arguments import say_notes
from legs_loss.system.terminal import say

HELP = "view trained Gaussians in the browser"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    parser.add_argument(
        "path", metavar="RUN|PLY|COMPARISON", type=Path, help="a training's folder, a .ply, or a folder of several"
    )
    parser.add_argument(
        "-s",
        "--scene",
        type=Path,
        metavar="DIR",
        help="the scene that was trained, for its cameras and photographs; default: the comparison's",
    )
    parser.add_argument("--preset", choices=PRESETS, default="legs", help="of the weight maps; default: legs")
    parser.add_argument("--port", type=int, default=8080, metavar="N", help="default: 8080, or the next that is free")
    parser.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="default: 127.0.0.1, for this machine only"
    )


def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from legs_loss.lab.viewer.content import find_content
    from legs_loss.lab.viewer.server import serve

    content = find_content(args.path, args.scene)
    say_notes(() if content.scene is None else content.scene.notes)
    server, address = serve(content, args.preset, args.host, args.port)
    say(f"{', '.join(content.methods)}: {address} (Ctrl-C ends)")
    try:
        while True:
            time.sleep(1)
    finally:
        server.stop()
