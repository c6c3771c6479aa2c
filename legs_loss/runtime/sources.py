"""Find the weight of a target: in the memo, in the store, or from the target itself, in this order.

The memo knows a target that it can prove to be the same as before. The store is used for the very image that its map
was made from, which the target's fingerprint tells. For all others the target itself is asked: a backend wants two
numbers of it, the least response and the span; torch wants the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Callable, Dict, Optional, Set, Tuple

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.errors import LegsError
from legs_loss.images import check_values
from legs_loss.kernels.backends import fused_range, is_capturing
from legs_loss.kernels.contract import Weights
from legs_loss.levels import RunningLevels, response_levels
from legs_loss.response import normalise_response, response
from legs_loss.runtime.call import Call
from legs_loss.runtime.memo import WeightMemo
from legs_loss.weights import error_weight_map, weight_from_response, weight_map, weight_over_scene

if TYPE_CHECKING:
    from legs_loss.store import Entry, WeightStore

__all__ = ["Counts", "WeightSource"]


@dataclass
class Counts:
    """Counts of this process's calls of ``l1_loss``, and of where its weights came from.

    Attributes:
        weighted: calls that trained with a weight.
        plain: calls that returned the plain mean: no gradient asked for, beta 0, LEGS_OFF, or `unweighted`.
        remembered: images whose weight was taken from the memo.
        stored: images whose weight map was taken from the store.
        computed: images whose weight was computed from them.
    """

    weighted: int = 0
    plain: int = 0
    remembered: int = 0
    stored: int = 0
    computed: int = 0


class WeightSource:
    """The memo and the store of a run.

    Args:
        config: of the run.
        memo_bytes: how much memory the memo may take.
        say_once: prints a line (kind of message, message) the first time that its kind occurs.
    """

    def __init__(self, config: Config, memo_bytes: int, say_once: Callable[[str, str], None]) -> None:
        self.config = config
        self.memo: WeightMemo = WeightMemo(memo_bytes)
        self._say_once = say_once
        self._asked: Set[Tuple[str, int, int]] = set()
        self._seen: RunningLevels = RunningLevels()
        self._of_store: Dict[int, Optional[Tensor]] = {}
        self._store: Optional[WeightStore] = None
        self._store_opened = False

    def weights(self, call: Call, counts: Counts) -> Weights:
        """Return the weights of a call's target, and count where each of them came from."""
        names = call.view_names()
        images = [call.target] if call.target.dim() == 3 else [call.target[i] for i in range(len(names))]
        found = [self._weight(image, name, call, counts) for image, name in zip(images, names)]
        spec = self.config.spec
        if spec.error > 0.0:
            normalised = found[0] if call.target.dim() == 3 else torch.stack(found)
            return Weights(map=error_weight_map(call.prediction, call.target, spec, call.channels_last, normalised))
        if spec.over == "scene":
            strength = found[0] if call.target.dim() == 3 else torch.stack(found)
            return Weights(map=weight_over_scene(strength, spec, self._scene_levels(found[0].numel())))
        if all(map(_is_range, found)):
            return Weights(spec=spec, range=torch.cat(found))
        maps = [
            weight_map(image, spec, call.channels_last) if _is_range(weight) else weight
            for image, weight in zip(images, found)
        ]
        return Weights(map=maps[0] if call.target.dim() == 3 else torch.stack(maps))

    def _weight(self, image: Tensor, view: Optional[str], call: Call, counts: Counts) -> Tensor:
        """Return an image's weight map [1, H, W] (channels-last [H, W, 1]), or the range that makes it, [1, 2].

        Where weights follow the rendering's error it is E^, all that is known of them before; where they are normalised
        over the scene it is E, since the scene's levels change with each view that is seen.
        """
        if is_capturing(image.device):
            # A CUDA graph is replayed with other pixels in the target's memory: their weight is part of the graph.
            counts.computed += 1
            return self._computed(image, call, again=True)
        if call.is_mean() and image.device.type == "cpu" and self.config.store is None:
            # Here to know an image again, by a SHA-256 of its bytes, takes longer than to compute its range.
            found = fused_range(image, self.config.spec, call.channels_last)
            if found is not None:
                counts.computed += 1
                return found
        before = counts.stored + counts.computed
        weight = self.memo.recall(image, lambda: self._made(image, view, call, counts), call.is_mean())
        counts.remembered += counts.stored + counts.computed == before
        return weight

    def _made(self, image: Tensor, view: Optional[str], call: Call, counts: Counts) -> Tensor:
        weight = self._stored(image, view, call.channels_last)
        if weight is not None:
            counts.stored += 1
            return weight
        counts.computed += 1
        return self._computed(image, call)

    def _computed(self, image: Tensor, call: Call, again: bool = False) -> Tensor:
        """Return what :meth:`_weight` returns of an image; ``again`` where it will be computed at each step."""
        spec = self.config.spec
        if spec.error > 0.0 or spec.over == "scene":
            if image.device.type == "cpu":
                check_values(image, "target")
            strength = response(image, spec.operator, spec.p, call.channels_last, spec.smooth)
            if spec.error > 0.0:
                return normalise_response(strength, spec.eps)
            if not again:
                self._seen.add(response_levels(strength, spec))
            return strength
        found = fused_range(image, spec, call.channels_last) if call.is_mean() else None
        return weight_map(image, spec, call.channels_last) if found is None else found

    def _stored(self, image: Tensor, view: Optional[str], channels_last: bool) -> Optional[Tensor]:
        store = self._open_store()
        if store is None:
            return None
        try:
            entry = self._entry(store, image.movedim(-1, 0) if channels_last else image, view)
            if entry is None:
                return None
            over_scene = self.config.spec.over == "scene"
            values = store.response(entry) if over_scene else store.normalised_response(entry)
        except LegsError as error:
            self._say_once("damaged", f"{error}; the weights of such views are computed")
            return None
        known = torch.from_numpy(values).to(image.device).unsqueeze(0)
        weight = known.float()
        if self.config.spec.error == 0.0 and not over_scene:
            weight = weight_from_response(known, self.config.spec)
        return weight.movedim(0, -1) if channels_last else weight

    def _scene_levels(self, pixels: int) -> Optional[Tensor]:
        """Return the levels of the scene: of all the store's views of this size, else of those seen so far."""
        store = self._open_store()
        if store is not None and pixels not in self._of_store:
            self._of_store[pixels] = store.scene_levels(self.config.spec, pixels)
        levels = self._of_store.get(pixels)
        if levels is not None:
            return levels
        self._say_once("running", _RUNNING)
        return self._seen.scene()

    def _entry(self, store: WeightStore, image: Tensor, view: Optional[str]) -> Optional[Entry]:
        """Return the store's entry that was made from an image [C, H, W]."""
        from legs_loss.store import fingerprint

        height, width = image.shape[1:]
        named = None if view is None else store.find(view, height, width, self.config.spec)
        if image.device.type != "cpu":
            # A fingerprint waits for the device: once a view. A target that is a new tensor at each step is computed.
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
            entry = entry or store.find_image(name, height, width, self.config.spec)
            if entry is not None:
                return entry
        if named is not None:
            self._say_once("changed", _CHANGED.format(view=view))
        elif view is not None:
            self._say_once("absent", f"the store has no map of view {view!r} at {width}x{height}: computed instead")
        return None

    def _open_store(self) -> Optional[WeightStore]:
        if not self._store_opened:
            self._store_opened = True
            if self.config.store is not None:
                from legs_loss.store import WeightStore

                try:
                    self._store = WeightStore(self.config.store)
                except LegsError as error:
                    self._say_once("damaged", f"{error}; weights are computed instead")
        return self._store


_RUNNING = (
    "weights are normalised over the views seen so far, a running estimate; legs precompute --preset legs-robust knows "
    "all views from the first step"
)
_CHANGED = (
    "view {view!r}: the training image is not the one that the stored map was made from, so its weight is computed "
    "(said once; see docs/precompute.md)"
)
_RENEWED = (
    "view {view!r}: its training image is a new tensor at each step, which on a GPU cannot be proven to be the stored "
    "map's without waiting for the device, so its weight is computed (said once; see docs/precompute.md)"
)


def _is_range(weight: Tensor) -> bool:
    return weight.dim() == 2
