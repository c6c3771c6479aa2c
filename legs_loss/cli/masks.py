"""Make masks of a scene's photographs without a neural network, one PNG per photograph; white counts, black does not.

WHAT is a folder of masks of your own, alpha (of the photographs), saturated or dark (over- or under-exposed in all
channels; black borders of undistorted photographs are dark), or sharpness (regions without contrast: out of focus, and
flat ones, too). With several, a pixel counts if it counts in all. A program that finds people, or a
paint program, can make such a folder, too: legs precompute SCENE --masks DIR reads it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Dict, List

from legs_loss.cli.shared.scene_arguments import add_images, read_noted, say_notes, say_skipped
from legs_loss.system.terminal import say

if TYPE_CHECKING:
    import numpy as np

    from legs_loss.scenes import View

HELP = "make masks of photographs: alpha, exposure, sharpness"

_COMPUTED = ("saturated", "dark", "sharpness")
_CLIPPED = 5  # of 255, from either end
_BLUNT = 0.1  # of the contrast that a tenth of the photograph has


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", type=Path, help="a scene, or a folder of photographs")
    what = ", ".join(("DIR", "FILE", "alpha", "mask_path", *_COMPUTED))
    parser.add_argument("--from", dest="kinds", nargs="+", required=True, metavar="WHAT", help=what)
    add_images(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="an empty or new folder; default: SCENE/masks")


def run(args: argparse.Namespace) -> int:
    """Write the masks; 1 when a photograph was skipped."""
    from tqdm import tqdm

    from legs_loss.cli.shared.checks import check_empty
    from legs_loss.errors import LegsError
    from legs_loss.precompute.user_maps import UserMaps, is_below
    from legs_loss.scenes.user_maps import file_names, find_maps, write_gray

    out = args.out or args.scene / "masks"
    check_empty(out)
    views = read_noted(args.scene, args.images).views
    folders = {}
    for kind in args.kinds:
        if kind not in _COMPUTED:
            views = tuple(view for view in views if not is_below(view.path, args.scene, UserMaps(kind)))
            folders[kind], strays = find_maps(args.scene, kind, views)
            if strays:
                say_notes([f"{kind}: these match no photograph: {', '.join(map(str, strays[:3]))}"])
    names = file_names(view.name for view in views)
    mostly: List[str] = []
    skipped: Dict[str, str] = {}
    for view in tqdm(views, "masks", unit="view"):
        try:
            mask = mask_of(view, args.kinds, folders)
            if not mask.any():
                raise LegsError("nothing of it would count")
        except LegsError as error:
            skipped[view.name] = str(error)
            continue
        if mask.mean() < 0.5:
            mostly.append(view.name)
        write_gray(out / names[view.name], mask)
    say_skipped(skipped)
    if mostly:
        say_notes([f"masked by more than half: {', '.join(mostly)}"])
    say(f"{out}: {len(views) - len(skipped)} masks, {len(skipped)} skipped")
    return 1 if skipped else 0


def mask_of(view: View, kinds: List[str], folders: Dict[str, Dict[str, Path]]) -> np.ndarray:
    """Return the mask of a photograph at its own size, float32 [H, W]."""
    import numpy as np

    from legs_loss.scenes import load_training_image
    from legs_loss.scenes.user_maps import averaged, read_mask

    photograph = load_training_image(view, 1)
    unit = photograph / np.float32(np.iinfo(photograph.dtype).max)
    height, width = unit.shape[:2]
    mask = np.ones((height, width), np.float32)
    for kind in kinds:
        if kind == "saturated":
            mask *= unit.min(-1) <= 1 - _CLIPPED / 255
        elif kind == "dark":
            mask *= unit.max(-1) >= _CLIPPED / 255
        elif kind == "sharpness":
            mask *= _is_sharp(unit)
        elif view.name in folders[kind]:
            mask *= averaged(read_mask(folders[kind][view.name], kind, (width, height)), (width, height)).clip(0, 1)
    return mask


def _is_sharp(unit: np.ndarray) -> np.ndarray:
    """Return where an image [H, W, C] has contrast: its response, averaged over a fiftieth of its height."""
    import numpy as np
    import torch

    from legs_loss.responses import gaussian_blur, response

    image = torch.from_numpy(np.ascontiguousarray(unit.transpose(2, 0, 1)))
    contrast = gaussian_blur(response(image, channels_last=False), max(1.0, unit.shape[0] / 50))[0].numpy()
    return contrast >= _BLUNT * np.quantile(contrast, 0.9)
