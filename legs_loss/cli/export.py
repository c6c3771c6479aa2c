"""Export a store's final weights as images for other programs, one a photograph, in the folders of the photographs.

OUT gets weights_8bit/ and weights_16bit/ (white is the largest weight of the scene, which is printed) and, where the
store has masks, masks/. STORE is the folder that legs precompute wrote, or the scene with it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Dict

from legs_loss.system.terminal import say

if TYPE_CHECKING:
    import numpy as np

    from legs_loss.spec import WeightSpec
    from legs_loss.store import Entry, WeightStore

HELP = "export final weights and masks as PNG for other programs"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    parser.add_argument("store", metavar="STORE", type=Path, help="a store's folder, or the scene that has one")
    parser.add_argument("out", metavar="OUT", type=Path, help="an empty or new folder")
    parser.add_argument("--preset", choices=PRESETS, default="legs", help="default: legs")


def run(args: argparse.Namespace) -> int:
    """Write the images; the largest size of each view."""
    import numpy as np

    from legs_loss.cli.shared.checks import check_empty
    from legs_loss.config import STORE_FOLDER
    from legs_loss.errors import LegsError
    from legs_loss.scenes.user_maps import file_names, write_gray
    from legs_loss.spec import as_spec
    from legs_loss.store import MASK, WeightStore

    check_empty(args.out)
    folder = args.store / STORE_FOLDER
    store, spec = WeightStore(folder if folder.is_dir() else args.store), as_spec(args.preset)
    fits = sorted((entry for entry in store.entries.values() if store.fits(entry, spec)), key=lambda entry: entry.width)
    views: Dict[str, Entry] = {entry.view: entry for entry in fits}
    if not views:
        raise LegsError(f"{store.path} has no maps for this preset: run legs precompute with --preset {args.preset}")
    largest = max(float(final_weight(store, entry, spec).max()) for entry in views.values())
    names = file_names(views)
    for view, entry in views.items():
        share = final_weight(store, entry, spec) / np.float32(largest or 1.0)
        write_gray(args.out / "weights_8bit" / names[view], share)
        write_gray(args.out / "weights_16bit" / names[view], share, np.uint16)
        mask = store.beside(entry, MASK)
        if mask is not None:
            write_gray(args.out / "masks" / names[view], store.user_map(mask))
    say(f"{args.out}: {len(views)} maps; white is a weight of {largest:.6g}")
    return 0


def final_weight(store: WeightStore, entry: Entry, spec: WeightSpec) -> np.ndarray:
    """Return the weight map of an entry that fits a spec, times the user's weights and mask, float32 [H, W]."""
    from legs_loss.store import MASK, WEIGHTS

    weight: np.ndarray = store.weight(entry, spec)[0].numpy()
    for users in filter(None, (store.beside(entry, kind) for kind in (MASK, WEIGHTS))):
        weight = weight * store.user_map(users)
    return weight
