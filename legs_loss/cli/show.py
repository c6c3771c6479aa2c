"""Draw a contact sheet (PNG): photograph, mask, response and weight map of some views, and the curves.

The maps of a SCENE or an IMAGE are computed; those of a STORE are drawn with the photographs of its scene. Masks are of
--masks or of the scene's own store.
"""

from __future__ import annotations

import argparse
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Callable, Dict, List, Optional, Sequence

from legs_loss.system.terminal import say

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from legs_loss.cli.shared.sheet import Shown
    from legs_loss.scenes import View
    from legs_loss.spec import WeightSpec
    from legs_loss.store import Entry

HELP = "draw a contact sheet of weight maps, and the curves"

_AT_MOST = 4  # views, unless they are chosen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    parser.add_argument("path", metavar="SCENE|STORE|IMAGE", help="what to show")
    parser.add_argument("--views", nargs="+", metavar="VIEW", help=f"names of views; default: {_AT_MOST} spread evenly")
    parser.add_argument("--masks", metavar="DIR|FILE|alpha", help="as for legs precompute; default: those of the store")
    parser.add_argument("--preset", choices=PRESETS, default="legs", help="default: legs")
    parser.add_argument("--out", default="sheet.png", metavar="PNG", help="default: sheet.png")


def run(args: argparse.Namespace) -> int:
    """Draw and save the sheet."""
    from tqdm import tqdm

    from legs_loss.cli.shared.scene_arguments import read_noted
    from legs_loss.cli.shared.sheet import save_sheet
    from legs_loss.errors import LegsError
    from legs_loss.precompute.photograph import levels_of
    from legs_loss.precompute.user_maps import UserMaps, is_below
    from legs_loss.scenes import View, image_tensor, load_training_image
    from legs_loss.spec import as_spec
    from legs_loss.store import MANIFEST

    path, spec = Path(args.path), as_spec(args.preset)
    if not path.exists():
        raise LegsError(f"there is no file or folder {path}: give a scene, a store or a photograph")
    shown: Dict[str, Callable[[], Shown]] = {}  # by the view's name
    if (path / MANIFEST).is_file():
        if args.masks is not None:
            raise LegsError("--masks is for a scene or a photograph: a store has the masks that it was made with")
        shown = _stored(path, spec)
    else:
        views = (View(path.name, path),) if path.is_file() else read_noted(path).views
        views = tuple(view for view in views if not is_below(view.path, path, UserMaps(args.masks)))
        masks = _masks(path, views, args.masks)
        read = tqdm(views, "levels of the scene", unit="view", disable=spec.over == "image")
        scene = levels_of((image_tensor(load_training_image(view)) for view in read), spec)
        shown = {view.name: partial(_computed, view, spec, scene, masks.get(view.name)) for view in views}
    names = _choose(list(shown), args.views)
    title = f"{args.preset}: {spec.operator}, p = {spec.p:g}, {spec.curve}, beta = {spec.beta:g}"
    save_sheet(args.out, [shown[name]() for name in names], spec, f"{path.resolve().name}   ·   {title}")
    say(args.out)
    return 0


def _masks(path: Path, views: Sequence[View], named: Optional[str]) -> Dict[str, Callable[[], np.ndarray]]:
    """Return what reads the mask of each view that has one: of a folder, its alpha, or of the scene's store."""
    from legs_loss.config import STORE_FOLDER
    from legs_loss.scenes import image_size
    from legs_loss.scenes.user_maps import find_maps, read_mask
    from legs_loss.store import MANIFEST, MASK, WeightStore

    if named is not None:
        files = {view.name: view.path for view in views}
        found, _ = find_maps(path, named, views)
        return {name: partial(read_mask, file, named, image_size(files[name])) for name, file in found.items()}
    if not (path / STORE_FOLDER / MANIFEST).is_file():
        return {}
    store = WeightStore(path / STORE_FOLDER)
    return {entry.view: partial(store.user_map, entry) for entry in store.of_kind(MASK)}


def _computed(view: View, spec: WeightSpec, scene: Optional[Tensor], mask: Optional[Callable[[], np.ndarray]]) -> Shown:
    from legs_loss.cli.shared.sheet import Shown
    from legs_loss.precompute import normalised_map, response_map
    from legs_loss.responses import over_scene
    from legs_loss.scenes import load_training_image
    from legs_loss.scenes.user_maps import averaged

    photograph = load_training_image(view)
    if spec.over == "image":
        normalised = normalised_map(photograph, spec)
    else:
        normalised = over_scene(response_map(photograph, spec)[None], spec, scene)[0].numpy()
    height, width = normalised.shape
    return Shown(view.name, photograph, normalised, 1.0 if mask is None else averaged(mask(), (width, height)))


def _stored(path: Path, spec: WeightSpec) -> Dict[str, Callable[[], Shown]]:
    import torch

    from legs_loss.cli.shared.sheet import Shown
    from legs_loss.errors import LegsError
    from legs_loss.precompute.origin import scene_of_store
    from legs_loss.responses import over_scene
    from legs_loss.store import MASK, WEIGHTS, WeightStore

    store, scene = WeightStore(path), scene_of_store(path)
    views = {} if scene is None else {view.name: view for view in scene.views}

    def draw(entry: Entry) -> Shown:
        view = views.get(entry.view)
        photograph = None if view is None else _photograph(view, entry)
        if spec.over == "image":
            normalised = store.normalised_response(entry)
        else:
            levels = store.scene_levels(spec, entry.width * entry.height)
            normalised = over_scene(torch.from_numpy(store.response(entry))[None], spec, levels)[0].numpy()
        found = [store.beside(entry, kind) for kind in (MASK, WEIGHTS)]
        mask, weights = (1.0 if one is None else store.user_map(one) for one in found)
        return Shown(f"{entry.view}\n{entry.width}x{entry.height}", photograph, normalised, mask, weights)

    # Of a view with several sizes, the largest comes last and stays.
    entries = sorted(store.entries.values(), key=lambda entry: (entry.view, entry.width))
    fits = [entry for entry in entries if store.fits(entry, spec)]
    if not fits:
        raise LegsError(f"{path} has no maps for this preset: show another, or run legs precompute with --preset")
    return {entry.view: partial(draw, entry) for entry in fits}


def _photograph(view: View, entry: Entry) -> Optional[np.ndarray]:
    """Return the image that a map was made from, None if it is missing or has changed."""
    from legs_loss.errors import LegsError
    from legs_loss.scenes import load_training_image
    from legs_loss.store import fingerprint

    with suppress(LegsError):
        for resolution in (-1, 1, 2, 4, 8, entry.width):
            photograph = load_training_image(view, resolution, entry.background == "white")
            if fingerprint(photograph) == entry.fingerprint:
                return photograph
    return None


def _choose(names: Sequence[str], chosen: Optional[Sequence[str]]) -> List[str]:
    from legs_loss.errors import LegsError
    from legs_loss.scenes.model import view_names

    if chosen is None:
        count = min(_AT_MOST, len(names))
        return [names[round(i * (len(names) - 1) / max(1, count - 1))] for i in range(count)]
    found = []
    for wanted in chosen:
        fits = [name for name in names if name == wanted] or [name for name in names if wanted in view_names(name)]
        if len(fits) != 1:
            what = f"fits {len(fits)} views" if fits else "is not a view"
            raise LegsError(f"--views: {wanted} {what}; there are {len(names)}, such as {', '.join(names[:4])}")
        found += fits
    return found
