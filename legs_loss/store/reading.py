"""A store, opened for reading."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.responses import scene_levels
from legs_loss.scenes.model import view_names
from legs_loss.spec import WeightSpec
from legs_loss.store.fingerprints import fingerprint, sampled_fingerprint
from legs_loss.store.leftovers import leftovers
from legs_loss.store.manifest import MASK, WEIGHTS, Entry, read_manifest
from legs_loss.store.maps import is_intact, read_map
from legs_loss.weights import weight_from_response, weight_over_scene


class Found(NamedTuple):
    """The view of one training image, and the entries for it: a response for a spec, the user's mask and weights."""

    view: str
    response: Optional[Entry]
    mask: Optional[Entry]
    weights: Optional[Entry]


class WeightStore:
    """A store, opened for reading: only its manifest is read.

    Args:
        path: the folder.

    Raises:
        LegsError: there is no store, or a newer version wrote it.
        DamagedStoreError: its manifest is damaged.
    """

    def __init__(self, path: Union[str, Path]) -> None:
        self.path: Path = Path(path)
        self.entries: Dict[Tuple[Any, ...], Entry] = {entry.key: entry for entry in read_manifest(self.path)}
        self._by_image: Dict[Tuple[Any, ...], List[Entry]] = {}
        self._levels: Dict[Tuple[WeightSpec, int], Optional[Tensor]] = {}
        for entry in self.entries.values():
            for name in (entry.fingerprint, entry.sample):
                self._by_image.setdefault((name, entry.height, entry.width), []).append(entry)

    def find(self, view: str, height: int, width: int, spec: WeightSpec) -> Optional[Entry]:
        """Return the entry of a view at a size for a spec's operator, or None.

        Args:
            view: the photograph's path in the scene or the last parts of it, with or without the extension, or up to
                the first dot as 3DGS names views. A name that fits two stored views returns None: it is ambiguous.
            height: of the training image in pixels.
            width: likewise.
            spec: what its response is made with counts; for one that is normalised over the scene, the entry must
                have what that needs.
        """
        wanted, key = view.replace("\\", "/"), (height, width, *_made_with(spec))
        named = [entry for entry in self.entries.values() if entry.key[1:] == key and wanted in view_names(entry.view)]
        return named[0] if len(named) == 1 and self.fits(named[0], spec) else None

    def find_image(self, image: Tensor, spec: WeightSpec) -> Optional[Found]:
        """Return what the store has of an image [C, H, W], whatever its view is called; None if that was never read.

        On the CPU every value of the image is compared; elsewhere a sample of them, which waits for the device.

        Raises:
            LegsError: two views have this very photograph, and different masks or weights.
        """
        name = fingerprint(image) if image.device.type == "cpu" else sampled_fingerprint(image)
        entries = self._by_image.get((name, *image.shape[1:]))
        if not entries:
            return None
        fits = [entry for entry in entries if self.fits(entry, spec)]
        mask, weights = (self._users_map(entries, kind) for kind in (MASK, WEIGHTS))
        return Found(entries[0].view, fits[0] if fits else None, mask, weights)

    def _users_map(self, entries: List[Entry], kind: str) -> Optional[Entry]:
        found = {entry.view: self.beside(entry, kind) for entry in entries}
        first, *others = found.values()
        if any((other and other.sha256) != (first and first.sha256) for other in others):
            raise LegsError(f"{self.path}: {', '.join(found)} are the same photograph, with different maps ({kind})")
        return first

    def beside(self, entry: Entry, kind: str) -> Optional[Entry]:
        """Return the entry of the user's own map, a kind of :data:`MASK` or :data:`WEIGHTS`, for an entry's view."""
        return self.entries.get((entry.view, entry.height, entry.width, kind, 1.0, 0.0, 0.0))

    def of_kind(self, kind: str) -> List[Entry]:
        """Return the user's own maps of a kind."""
        return [entry for entry in self.entries.values() if entry.operator == kind]

    def user_map(self, entry: Entry) -> np.ndarray:
        """Return a mask, in [0, 1], or weights of the user's, float32 [H, W].

        Raises:
            DamagedStoreError: the file is missing or is not the one that was written.
        """
        return self.response(entry) if entry.operator == WEIGHTS else read_map(self.path, entry).astype(np.float32)

    @staticmethod
    def fits(entry: Entry, spec: WeightSpec) -> bool:
        """Return whether the weights of a spec can be made from an entry's map."""
        return entry.key[3:] == _made_with(spec) and (spec.over == "image" or entry.percentile == spec.percentile)

    def scene_levels(self, spec: WeightSpec, pixels: int) -> Optional[Tensor]:
        """Return the levels of the scene (:mod:`legs_loss.responses`) over all views of a number of pixels, [2].

        None where the store holds none for this spec: ``legs precompute`` was run for another preset.
        """
        key = spec, pixels
        if key not in self._levels:
            views = [
                torch.tensor([entry.median, entry.strong])
                for entry in self.entries.values()
                if self.fits(entry, spec) and entry.width * entry.height == pixels
            ]
            self._levels[key] = scene_levels(views) if views else None
        return self._levels[key]

    def response(self, entry: Entry) -> np.ndarray:
        """Return an entry's response before it was normalised, float32 [H, W]; the entry must have ``span``.

        Raises:
            DamagedStoreError: the file is missing or is not the one that was written.
        """
        assert entry.low is not None
        assert entry.span is not None
        return np.float32(entry.low) + np.float32(entry.span) * read_map(self.path, entry).astype(np.float32)

    def normalised_response(self, entry: Entry) -> np.ndarray:
        """Return an entry's map E^, float16 [H, W], after checking its checksum.

        Raises:
            DamagedStoreError: the file is missing or is not the one that was written.
        """
        return read_map(self.path, entry)

    def weight(self, entry: Entry, spec: WeightSpec, device: Union[str, torch.device] = "cpu") -> Tensor:
        """Return the weight map [1, H, W] of an entry that fits a spec, made on a device; :meth:`response` raises."""
        over_scene = spec.over == "scene"
        values = self.response(entry) if over_scene else self.normalised_response(entry)
        made = torch.from_numpy(values).to(device)[None]
        if over_scene:
            return weight_over_scene(made, spec, self.scene_levels(spec, values.size))
        return weight_from_response(made, spec)

    def check(self) -> Tuple[List[Entry], List[str]]:
        """Read every map; return the entries whose map is damaged or missing, and the files that belong to no entry."""
        entries = self.entries.values()
        damaged = [entry for entry in entries if not is_intact(self.path, entry)]
        return (damaged, sorted(path.name for path in leftovers(self.path, entries)))


def _made_with(spec: WeightSpec) -> Tuple[Any, ...]:
    """Return the last part of the keys of the maps that a spec can use."""
    return spec.operator, spec.p, spec.eps, spec.smooth
