"""Find the weight of an image in the store of a run, for exactly the image that a map was made from."""

from __future__ import annotations

from typing import TYPE_CHECKING, Callable, Dict, Optional, Set, Tuple

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.errors import LegsError
from legs_loss.weights import weight_from_response

if TYPE_CHECKING:
    from legs_loss.store import Entry, WeightStore

__all__ = ["StoredWeights"]

_CHANGED = (
    "view {view!r}: the training image is not the one that the stored map was made from, so its weight is computed "
    "(said once; see docs/precompute.md)"
)
_RENEWED = (
    "view {view!r}: its training image is another tensor than before, or on another stream; on a GPU it cannot be "
    "proven to be the stored map's without waiting for the device, so its weight is computed (said once; see "
    "docs/precompute.md)"
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
        self._asked: Set[Tuple[str, int, int]] = set()
        self._levels: Dict[int, Optional[Tensor]] = {}
        self._store: Optional[WeightStore] = None
        self._opened = False

    def weight(self, image: Tensor, view: Optional[str]) -> Optional[Tensor]:
        """Return an image's weight map [1, H, W], None if no map was made from this image.

        Where weights follow the rendering's error it is E^; where they are normalised over the scene, E.

        Args:
            image: [C, H, W].
            view: its name, if the call gave one.
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
        from legs_loss.store import fingerprint

        height, width = image.shape[1:]
        named = None if view is None else store.find(view, height, width, self._config.spec)
        if image.device.type != "cpu":
            # A fingerprint waits for the device, so it is computed once per view; new tensors are recomputed.
            if named is None:
                reason = "the call names no view (view=)" if view is None else f"it has no map of view {view!r}"
                self._say_once(
                    "absent", f"{store.path} is not used: {reason} at {width}x{height}; weights are computed"
                )
                return None
            if (str(view), height, width) in self._asked:
                self._say_once("renewed", _RENEWED.format(view=view))
                return None
            self._asked.add((str(view), height, width))
            if named.fingerprint == fingerprint(image):
                return named
        else:
            name = fingerprint(image)
            entry = named if named is not None and named.fingerprint == name else None
            entry = entry or store.find_image(name, height, width, self._config.spec)
            if entry is not None:
                return entry
        if named is not None:
            self._say_once("changed", _CHANGED.format(view=view))
        elif view is not None:
            self._say_once("absent", f"the store has no map of view {view!r} at {width}x{height}: computed instead")
        return None

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
