"""The user's masks and weights -> entries of a store, all checked before anything is written."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.scenes import View, image_size, training_size
from legs_loss.scenes.folder import SUFFIXES
from legs_loss.scenes.user_maps import ALPHA, MASK_PATH, averaged, find_maps, map_path, read_map_file, read_mask
from legs_loss.store import MASK, WEIGHTS, Entry, stage

_LARGEST = 1e6  # weight
_OF_THE_SCENE = (None, ALPHA, MASK_PATH)
_OPTIONS = {MASK: "--masks", WEIGHTS: "--weights"}
_SUFFIXES = {MASK: SUFFIXES, WEIGHTS: (*SUFFIXES, ".npy")}


class UserMaps(NamedTuple):
    """The places of the user's own maps: folders, or a file for all views, in the scene or paths; None without.

    Attributes:
        masks: or "alpha", for that of the photographs, or "mask_path", for those that transforms.json names. White
            counts, black does not.
        weights: W of a pixel is the map's value, of an image in [0, 1], times the scale.
        scale: of the weights.
    """

    masks: Optional[str] = None
    weights: Optional[str] = None
    scale: float = 1.0


NO_MAPS: UserMaps = UserMaps()


def is_below(path: Path, root: Path, maps: UserMaps) -> bool:
    """Return whether a file is one of the user's maps or lies in one of their folders, and so is no photograph."""
    places = [map_path(root, named).resolve() for named in (maps.masks, maps.weights) if named not in _OF_THE_SCENE]
    return any(place in (path.resolve(), *path.resolve().parents) for place in places)


def stage_user_maps(
    root: Path, views: Sequence[View], resolution: int, maps: UserMaps, known: Sequence[Entry], staging: Path
) -> Tuple[List[Entry], List[str]]:
    """Read, check and stage all of the user's maps, at every size that the store has or is to have of a view.

    Returns their entries, which take the place of all of the user's that the store has, and notes for the user.

    Args:
        root, views: of the scene.
        resolution: 3DGS's ``-r``.
        maps: where they are.
        known: what the store has.
        staging: the writer's folder.

    Raises:
        LegsError: a map that cannot be used, the first one's file and why; or the store has maps of a kind that is not
            given again, which new photographs and sizes would be without.
    """
    if not 0.0 < maps.scale <= _LARGEST:
        raise LegsError(f"--weight_scale must be above 0 and at most {_LARGEST:g}, got {maps.scale:g}")
    added: List[Entry] = []
    notes: List[str] = []
    masked = sum(view.mask is not None for view in views)
    if masked and maps.masks is None:
        notes.append(f"transforms.json names masks of {masked} photograph(s): --masks mask_path applies them")
    given = {kind: named for kind, named in ((MASK, maps.masks), (WEIGHTS, maps.weights)) if named is not None}
    sizes: Dict[str, Tuple[int, int]] = {}
    for view in views if given else ():
        with suppress(LegsError):  # its photograph is skipped later, with the reason
            sizes[view.name] = image_size(view.path)
    views = [view for view in views if view.name in sizes]
    trained = {name: {training_size(*size, resolution)} for name, size in sizes.items()}
    for entry in known:
        if entry.is_users and entry.operator not in given:
            raise LegsError(f"the store has maps of {_OPTIONS[entry.operator]}: give it again, or delete the store")
        if not entry.is_users and entry.view in trained:
            trained[entry.view].add((entry.width, entry.height))
    for kind, named in given.items():
        files, strays = find_maps(root, named, views, _SUFFIXES[kind])
        if strays:
            notes.append(
                f"{_OPTIONS[kind]}: {len(strays)} file(s) are left out, which have the name of no photograph of the "
                f"scene, such as {strays[0]} (COLMAP leaves out photographs whose camera it did not find)"
            )
        for view in views:
            if view.name in files:
                file, size = files[view.name], sizes[view.name]
                values = read_mask(file, named, size) if kind == MASK else read_map_file(file, size)
                for size in sorted(trained[view.name]):
                    added.append(_staged(kind, view, file, averaged(values, size), maps.scale, staging))
        whole = [view.name for view in views if view.name not in files]
        if kind == MASK and whole:
            notes.append(f"counted whole, without a mask: {', '.join(whole)}")
    return added, notes


def _staged(kind: str, view: View, file: Path, values: np.ndarray, scale: float, staging: Path) -> Entry:
    values = values.clip(0.0, 1.0) if kind == MASK else values * np.float32(scale)
    largest = float(values.max())
    if not 0.0 < largest <= _LARGEST:
        what = "all black: nothing of its photograph would count" if largest == 0.0 else f"a weight of {largest:g}"
        raise LegsError(f"{file}: {what}")
    levels: Dict[str, Any] = {}
    if kind == WEIGHTS:
        values = values / np.float32(largest)
        levels = {"low": 0.0, "span": largest, "percentile": 100.0, "median": 0.0, "strong": largest}
    height, width = values.shape
    return stage(staging, Entry(view.name, width, height, kind, 1.0, 0.0, None, "", 0, 0, **levels), values)
