"""Find what the store of a run has of an image, for exactly the image that its maps belong to."""

from __future__ import annotations

import weakref
from enum import Enum
from typing import TYPE_CHECKING, Callable, Optional, Set, Tuple, Union

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.errors import LegsError
from legs_loss.responses import NEEDS_LEVELS

if TYPE_CHECKING:
    from legs_loss.store import Found, WeightStore

_MISSES = 2  # lookups for each map of the store

_ABSENT = (
    "{store} has no map of the training image{view} of {size}: another size or other pixels than legs precompute "
    "read; the weight of such images is computed (said once; see docs/precompute.md)"
)
_UNMASKED = (
    "NOT MASKED: {store} has masks, but none for the training image{view} of {size}, which counts whole: {reason} "
    "(said once; LEGS_MASKS=require stops instead; see docs/masks.md)"
)
_OTHER_SIZE = "the store has {sizes}; give legs precompute the training's -r and --images"
_OTHER_PIXELS = (
    "its pixels match no photograph that legs precompute read, so it was changed on the way: augmented, shifted, "
    "resized or laid on another background"
)


class Whole(Enum):
    """Reasons for an image to count whole: the store has no mask or weights for it, or does not know it."""

    KNOWN = 0
    UNKNOWN = 1


class Stored:
    """The store of a run, opened when it is first needed.

    Args:
        config: of the run.
        say_once: prints a line (kind of message, message) the first time that its kind occurs.

    Raises:
        LegsError: LEGS_MASKS=require, and there is no store with masks.
    """

    def __init__(self, config: Config, say_once: Callable[[str, str], None]) -> None:
        self.masked: Set[str] = set()  # names of the views with a mask, and of those without
        self.whole: Set[str] = set()
        self._config = config
        self._say_once = say_once
        self._misses = 0  # since an image was found
        self._last: Optional[Tuple[weakref.ref[Tensor], int, Optional[Found]]] = None
        self._store: Optional[WeightStore] = None
        self._kinds: Set[str] = set()
        self._opened = False

    def weight(self, image: Tensor, view: Optional[str]) -> Optional[Tensor]:
        """Return an image's weight map [1, H, W], None if no map was made from this image.

        Args:
            image: [C, H, W].
            view: its name, if the call gave one, for messages.
        """
        store = self._open()
        found = None if store is None else self._find(store, image, view)
        if store is None or found is None or found.response is None:
            return None
        try:
            return store.weight(found.response, self._config.spec, image.device)
        except LegsError as error:
            self._say_once("damaged", f"{error}; the weights of such views are computed")
            return None

    def has(self, *kinds: str) -> bool:
        """Return whether the store has maps of the user's own of any of these kinds."""
        self._open()
        return not self._kinds.isdisjoint(kinds)

    def summary(self, absent: int, in_l1_alone: bool) -> str:
        """Return the line of a run's end; ``absent`` is how often an image was not found."""
        parts = [f"{len(self.masked)} view(s) masked"]
        parts += [f"{len(self.whole)} without a mask counted whole"] if self.whole else []
        parts += [f"{absent} training image(s) were NOT FOUND in the store, so NOT MASKED"] if absent else []
        parts += ["in the L1 alone: legs-patch --masks hides masked pixels from other terms"] if in_l1_alone else []
        return f"masks: {', '.join(parts)}"

    def users_map(self, image: Tensor, view: Optional[str], kind: str) -> Union[Tensor, Whole]:
        """Return the user's mask or weights of an image, float32 [1, H, W]; or why it counts whole.

        Raises:
            LegsError: a file of the store is damaged; or LEGS_MASKS=require, and the image is not in the store.
        """
        from legs_loss.store import MASK

        store = self._open()
        assert store is not None
        found = self._find(store, image, view)
        if found is None:
            if kind == MASK:
                self._say_unmasked(store, image, view)
            return Whole.UNKNOWN
        entry = found.mask if kind == MASK else found.weights
        if kind == MASK:
            (self.whole if entry is None else self.masked).add(found.view)
        if entry is None:
            return Whole.KNOWN
        return torch.from_numpy(store.user_map(entry)).to(image.device).unsqueeze(0)

    def scene_levels(self, pixels: int) -> Tensor:
        """Return the levels of all the store's views of a number of pixels, [2].

        Raises:
            LegsError: there is no store, or it lacks the levels of views of this size.
        """
        store = self._open()
        levels = None if store is None else store.scene_levels(self._config.spec, pixels)
        if levels is None:
            where = "no store of this run has" if store is None else f"{store.path} does not have for {pixels} pixels"
            then = "and let the run find its store (-s SCENE, LEGS_STORE)"
            raise LegsError(NEEDS_LEVELS.format(where=where, then=then))
        return levels

    def _find(self, store: WeightStore, image: Tensor, view: Optional[str]) -> Optional[Found]:
        """Return what the store has of an image [C, H, W]; with masks or weights of the user's it is always asked."""
        if not self._kinds and self._misses >= _MISSES * len(store.entries):
            return None  # targets that are new at each step, and a lookup waits for a device
        version = 0 if image.is_inference() else image._version
        last = self._last  # one lookup a step; on the CPU memory that numpy shares changes without a new version
        if last is not None and last[0]() is image and last[1] == version and image.device.type != "cpu":
            return last[2]
        found = store.find_image(image, self._config.spec)
        self._last = weakref.ref(image), version, found
        self._misses = 0 if found is not None else self._misses + 1
        if found is None and not self._kinds:
            self._say_once("absent", _ABSENT.format(store=store.path, view=_named(view), size=_size(image)))
        return found

    def _say_unmasked(self, store: WeightStore, image: Tensor, view: Optional[str]) -> None:
        sizes = sorted({f"{entry.width}x{entry.height}" for entry in store.entries.values()})
        reason = _OTHER_PIXELS if _size(image) in sizes else _OTHER_SIZE.format(sizes=", ".join(sizes[:4]))
        message = _UNMASKED.format(store=store.path, view=_named(view), size=_size(image), reason=reason)
        if self._config.require_masks:
            raise LegsError(message)
        self._say_once("unmasked", message)

    def _open(self) -> Optional[WeightStore]:
        if self._opened:
            return self._store
        if self._config.store is not None:
            from legs_loss.store import WeightStore

            try:
                self._store = WeightStore(self._config.store)
                self._kinds = {entry.operator for entry in self._store.entries.values() if entry.is_users}
            except LegsError as error:
                if self._config.require_masks:
                    raise
                self._say_once("damaged", f"{error}; weights are computed instead")
        if self._config.require_masks and "mask" not in self._kinds:
            where = "there is no store" if self._store is None else f"{self._store.path} has no masks"
            raise LegsError(f"LEGS_MASKS=require, but {where}: legs precompute SCENE --masks DIR makes one")
        self._opened = True
        return self._store


def _named(view: Optional[str]) -> str:
    return "" if view is None else f" of view {view!r}"


def _size(image: Tensor) -> str:
    return f"{image.shape[2]}x{image.shape[1]}"
