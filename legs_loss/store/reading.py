"""A store, opened for reading."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Tuple, Union

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.levels import scene_levels
from legs_loss.scenes.model import view_names
from legs_loss.spec import WeightSpec
from legs_loss.store.fingerprints import fingerprint, sampled_fingerprint
from legs_loss.store.leftovers import leftovers
from legs_loss.store.manifest import MANIFEST, Entry, read_manifest
from legs_loss.store.maps import is_intact, read_map

__all__ = ["Damage", "WeightStore"]


class Damage(NamedTuple):
    """The damage of a store: entries whose map is damaged or missing, and files that belong to no entry."""

    damaged: List[Entry]
    orphans: List[str]


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
        if not os.path.lexists(str(self.path / MANIFEST)):
            raise LegsError(
                f"{self.path} is not a store of weight maps: it has no {MANIFEST} (legs precompute writes one)"
            )
        self.entries: Dict[Tuple[Any, ...], Entry] = {entry.key: entry for entry in read_manifest(self.path)}
        self._by_name: Dict[Tuple[Any, ...], Optional[Entry]] = {}
        self._by_image: Dict[Tuple[Any, ...], Entry] = {}
        for entry in self.entries.values():
            for name in (entry.fingerprint, entry.sample):
                image = (name, *entry.key[1:])
                self._by_image[image] = entry
            for name in view_names(entry.view):
                key = (name, *entry.key[1:])
                self._by_name[key] = None if key in self._by_name else entry

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
        entry = self._by_name.get((view.replace("\\", "/"), height, width, *_made_with(spec)))
        return entry if entry is not None and self.fits(entry, spec) else None

    def find_image(self, image: Tensor, spec: WeightSpec) -> Optional[Entry]:
        """Return the entry that was made from an image [C, H, W], whatever its view is called, or None.

        On the CPU every value of the image is compared; elsewhere a sample of them, which waits for the device.
        """
        name = fingerprint(image) if image.device.type == "cpu" else sampled_fingerprint(image)
        entry = self._by_image.get((name, *image.shape[1:], *_made_with(spec)))
        return entry if entry is not None and self.fits(entry, spec) else None

    @staticmethod
    def fits(entry: Entry, spec: WeightSpec) -> bool:
        """Return whether the weights of a spec can be made from an entry's map."""
        return entry.key[3:] == _made_with(spec) and (spec.over == "image" or entry.percentile == spec.percentile)

    def scene_levels(self, spec: WeightSpec, pixels: int) -> Optional[Tensor]:
        """Return the levels of the scene (:mod:`legs_loss.levels`) over all views of a number of pixels, [2].

        None where the store holds none for this spec: ``legs precompute`` was run for another preset.
        """
        views = [
            torch.tensor([entry.median, entry.strong])
            for entry in self.entries.values()
            if self.fits(entry, spec) and entry.width * entry.height == pixels
        ]
        return scene_levels(views) if views else None

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

    def check(self) -> Damage:
        """Read every map and compare checksums."""
        entries = self.entries.values()
        damaged = [entry for entry in entries if not is_intact(self.path, entry)]
        return Damage(damaged, sorted(path.name for path in leftovers(self.path, entries)))


def _made_with(spec: WeightSpec) -> Tuple[Any, ...]:
    """Return the last part of the keys of the maps that a spec can use."""
    return spec.operator, spec.p, spec.eps, spec.smooth
