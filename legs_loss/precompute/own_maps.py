"""The user's masks and weights -> entries of a store, all checked before anything is written."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.scenes import View, image_size, training_size
from legs_loss.scenes.folder import SUFFIXES
from legs_loss.scenes.own_maps import averaged, find_maps, has_alpha, read_alpha, read_map_file
from legs_loss.store import MASK, WEIGHTS, Entry, stage

__all__ = ["ALPHA", "NO_MAPS", "OwnMaps", "is_below", "own_folder", "stage_own"]

ALPHA = "alpha"
_LARGEST = 1e6  # weight
_OPTIONS = {MASK: "--masks", WEIGHTS: "--weights"}
_SUFFIXES = {MASK: SUFFIXES, WEIGHTS: (*SUFFIXES, ".npy")}


class OwnMaps(NamedTuple):
    """The places of the user's own maps: folders, in the scene or paths; None without.

    Attributes:
        masks: or "alpha", for that of the photographs. White counts, black does not.
        weights: W of a pixel is the map's value, of an image in [0, 1], times the scale.
        scale: of the weights.
    """

    masks: Optional[str] = None
    weights: Optional[str] = None
    scale: float = 1.0


NO_MAPS: OwnMaps = OwnMaps()


class Staged(NamedTuple):
    """Entries to add to a store and to remove from it, and the views without a mask where others have one."""

    added: List[Entry]
    dropped: List[Entry]
    unmasked: List[str]


def own_folder(root: Path, named: str) -> Path:
    """Return the folder of maps that was named: in the scene, or a path."""
    return root / named if (root / named).is_dir() else Path(named)


def is_below(path: Path, root: Path, maps: OwnMaps) -> bool:
    """Return whether a file lies in one of the folders of the user's maps, and so is no photograph."""
    folders = [own_folder(root, named).resolve() for named in (maps.masks, maps.weights) if named not in (None, ALPHA)]
    return any(folder in path.resolve().parents for folder in folders)


def stage_own(
    root: Path, views: Sequence[View], resolution: int, maps: OwnMaps, known: Sequence[Entry], staging: Path
) -> Staged:
    """Read, check and stage all of the user's maps, at every size that the store has or is to have of a view.

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
    result = Staged([], [], [])
    given = {kind: named for kind, named in ((MASK, maps.masks), (WEIGHTS, maps.weights)) if named is not None}
    for entry in known:
        if entry.is_own and entry.operator not in given:
            raise LegsError(
                f"the store has maps of {_OPTIONS[entry.operator]}: give that option again, or delete the store"
            )
    if not given:
        return result
    sizes: Dict[str, Tuple[int, int]] = {}
    for view in views:
        with suppress(LegsError):  # its photograph is skipped later, with the reason
            sizes[view.name] = image_size(view.path)
    views = [view for view in views if view.name in sizes]
    trained = {view.name: {training_size(*sizes[view.name], resolution)} for view in views}
    for entry in known:
        if not entry.is_own and entry.view in trained:
            trained[entry.view].add((entry.width, entry.height))
    for kind, named in given.items():
        is_alpha = kind == MASK and named == ALPHA
        files = _with_alpha(views) if is_alpha else find_maps(own_folder(root, named), views, _SUFFIXES[kind])
        for view in views:
            if view.name in files:
                file = files[view.name]
                values = read_alpha(file) if is_alpha else read_map_file(file, sizes[view.name])
                for size in sorted(trained[view.name]):
                    result.added.append(_staged(kind, view, file, averaged(values, size), maps.scale, staging))
            elif kind == MASK:
                result.unmasked.append(view.name)
        result.dropped.extend(entry for entry in known if entry.operator == kind)
    return result


def _with_alpha(views: Sequence[View]) -> Dict[str, Path]:
    found = {view.name: view.path for view in views if has_alpha(view.path)}
    if not found:
        raise LegsError(f"--masks alpha: none of the {len(views)} photographs has an alpha channel")
    return found


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
