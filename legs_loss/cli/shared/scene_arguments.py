"""The arguments for a scene and its photographs, and what is said of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Iterable, Mapping, Optional, Union

from legs_loss.system.terminal import say

if TYPE_CHECKING:
    from legs_loss.scenes import Scene


def add_images(parser: Any) -> None:
    """Declare the folder of a scene's photographs."""
    parser.add_argument("--images", metavar="DIR", help='folder of the photographs, in the scene or a path ("images")')


def add_resolution(parser: Any, without: str = "at most 1600 wide", **more: Any) -> None:
    """Declare 3DGS's -r, and say what is done without it."""
    what = f"as in 3DGS; default: {without}"
    parser.add_argument("-r", "--resolution", type=int, metavar="1|2|4|8|WIDTH", help=what, **more)


def say_skipped(skipped: Mapping[str, str], most: int = 20) -> None:
    """Print the first of the views that were skipped, each with the reason, and how many more there are."""
    for view, reason in list(skipped.items())[:most]:
        say(f"legs: skipped {view}: {reason}", sys.stderr)
    if len(skipped) > most:
        say(f"legs: skipped {len(skipped) - most:,} more", sys.stderr)


def read_noted(path: Union[str, Path], images: Optional[str] = None) -> Scene:
    """Read a scene, and say on stderr what was left out of it; see :func:`~legs_loss.scenes.read_scene`."""
    from legs_loss.scenes import read_scene

    scene = read_scene(path, images)
    say_notes(scene.notes)
    return scene


def say_notes(notes: Iterable[str]) -> None:
    """Say sentences for the user on stderr, such as what was left out of a scene."""
    for note in notes:
        say(f"legs: note: {note}", sys.stderr)
