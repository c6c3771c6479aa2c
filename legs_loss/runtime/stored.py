"""Find the weight of an image in the store of a run, for exactly the image that a map was made from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Callable, Dict, Optional

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.errors import LegsError
from legs_loss.weights import weight_from_response

if TYPE_CHECKING:
    from legs_loss.store import Entry, WeightStore

__all__ = ["StoredWeights"]

_MISSES = 2  # lookups for each view of the store

_ABSENT = (
    "{store} has no map of the training image{view} of {width}x{height}: another size or other pixels than legs "
    "precompute read; the weight of such images is computed (said once; see docs/precompute.md)"
)


class StoredWeights:
    """The store of a run, opened when it is first needed.

    Args:
        config: of the run.
        say_once: prints a line (kind of message, message) the first time that its kind occurs.
    """

    def __init__(self, config: Config, say_once: Callable[[str, str], None]) -> None:
        self._config = config
        self._say_once = say_once
        self._misses = 0  # since an image was found
        self._levels: Dict[int, Optional[Tensor]] = {}
        self._store: Optional[WeightStore] = None
        self._opened = False

    def weight(self, image: Tensor, view: Optional[str]) -> Optional[Tensor]:
        """Return an image's weight map [1, H, W], None if no map was made from this image.

        Where weights follow the rendering's error it is E^; where they are normalised over the scene, E.

        Args:
            image: [C, H, W].
            view: its name, if the call gave one, for messages.
        """
        store = self._open()
        if store is None:
            return None
        try:
            entry = self._entry(store, image, view)
            if entry is None:
                return None
            over_scene = self._config.spec.over == "scene"
            values = store.response(entry) if over_scene else store.normalised_response(entry)
        except LegsError as error:
            self._say_once("damaged", f"{error}; the weights of such views are computed")
            return None
        known = torch.from_numpy(values).to(image.device).unsqueeze(0)
        weight = known.float()
        if not over_scene:
            weight = weight_from_response(known, self._config.spec)
        return weight

    def scene_levels(self, pixels: int) -> Optional[Tensor]:
        """Return the levels of all the store's views of this size, None where it lacks them."""
        store = self._open()
        if store is not None and pixels not in self._levels:
            self._levels[pixels] = store.scene_levels(self._config.spec, pixels)
        return self._levels.get(pixels)

    def _entry(self, store: WeightStore, image: Tensor, view: Optional[str]) -> Optional[Entry]:
        """Return the store's entry that was made from an image [C, H, W]."""
        if self._misses >= _MISSES * len(store.entries):
            return None  # targets that are new at each step, and a lookup waits for a device
        found = store.find_image(image, self._config.spec)
        entry = None if found is None else found.response
        self._misses = 0 if entry is not None else self._misses + 1
        if entry is None:
            height, width = image.shape[1:]
            named = "" if view is None else f" of view {view!r}"
            self._say_once("absent", _ABSENT.format(store=store.path, view=named, width=width, height=height))
        return entry

    def _open(self) -> Optional[WeightStore]:
        if not self._opened:
            self._opened = True
            if self._config.store is not None:
                from legs_loss.store import WeightStore

                try:
                    self._store = WeightStore(self._config.store)
                except LegsError as error:
                    self._say_once("damaged", f"{error}; weights are computed instead")
        return self._store
