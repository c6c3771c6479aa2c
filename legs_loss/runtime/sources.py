"""Find the weight of a target: in the memo, in the store, or from the target itself, in this order.

The memo has targets that are provably unchanged. The store is used for exactly the image that its map was made from, by
the target's fingerprint. In all other cases the weight is computed: a backend needs two numbers of the target, the
least response and the span; torch needs the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Callable, Optional

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.images import check_values
from legs_loss.kernels.available import is_capturing
from legs_loss.kernels.backends import fused_range
from legs_loss.kernels.contract import Weights
from legs_loss.levels import RunningLevels, response_levels
from legs_loss.response import response
from legs_loss.runtime.call import Call
from legs_loss.runtime.memo import WeightMemo
from legs_loss.runtime.stored import StoredWeights
from legs_loss.weights import weight_map, weight_over_scene

__all__ = ["Counts", "WeightSource"]


@dataclass
class Counts:
    """Counts of this process's calls of ``l1_loss``, and of the sources of the weights.

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
        counts: counts where each weight came from.
        say_once: prints a line (kind of message, message) the first time that its kind occurs.
    """

    def __init__(self, config: Config, memo_bytes: int, counts: Counts, say_once: Callable[[str, str], None]) -> None:
        self.config = config
        self.memo: WeightMemo = WeightMemo(memo_bytes)
        self._counts = counts
        self._say_once = say_once
        self._stored: StoredWeights = StoredWeights(config, say_once)
        self._seen: RunningLevels = RunningLevels()

    def weights(self, call: Call) -> Weights:
        """Return the weights of a call's target, and count their sources."""
        names = call.view_names()
        images = [call.target] if call.target.dim() == 3 else [call.target[i] for i in range(len(names))]
        found = [self._weight(image, name, call) for image, name in zip(images, names)]
        spec = self.config.spec
        if spec.over == "scene":
            strength = found[0] if call.target.dim() == 3 else torch.stack(found)
            return Weights(map=weight_over_scene(strength, spec, self._scene_levels(found[0].numel())))
        if all(map(_is_range, found)):
            return Weights(spec=spec, range=torch.cat(found))
        maps = [weight_map(image, spec, False) if _is_range(weight) else weight for image, weight in zip(images, found)]
        return Weights(map=maps[0] if call.target.dim() == 3 else torch.stack(maps))

    def _weight(self, image: Tensor, view: Optional[str], call: Call) -> Tensor:
        """Return an image's weight map [1, H, W], or the range that makes it, [1, 2].

        For weights normalised over the scene it is E, since the scene's levels change with each new view.
        """
        counts = self._counts
        if is_capturing(image.device):
            # A CUDA graph is replayed with other pixels in the target's memory: their weight is part of the graph.
            counts.computed += 1
            return self._computed(image, call, again=True)
        if call.is_mean() and image.device.type == "cpu" and self.config.store is None:
            # Here a SHA-256 of an image's bytes takes longer than its range.
            found = fused_range(image, self.config.spec)
            if found is not None:
                counts.computed += 1
                return found
        before = counts.stored + counts.computed
        weight = self.memo.recall(image, lambda: self._made(image, view, call), call.is_mean())
        counts.remembered += counts.stored + counts.computed == before
        return weight

    def _made(self, image: Tensor, view: Optional[str], call: Call) -> Tensor:
        weight = self._stored.weight(image, view)
        if weight is not None:
            self._counts.stored += 1
            return weight
        self._counts.computed += 1
        return self._computed(image, call)

    def _computed(self, image: Tensor, call: Call, again: bool = False) -> Tensor:
        """Return what :meth:`_weight` returns of an image; ``again`` where it will be computed at each step."""
        spec = self.config.spec
        if spec.over == "scene":
            if image.device.type == "cpu":
                check_values(image, "target")
            strength = response(image, spec.operator, spec.p, False, spec.smooth)
            if not again:
                self._seen.add(response_levels(strength, spec))
            return strength
        found = fused_range(image, spec) if call.is_mean() else None
        return weight_map(image, spec, False) if found is None else found

    def _scene_levels(self, pixels: int) -> Optional[Tensor]:
        """Return the levels of the scene: of all the store's views of this size, else of those seen so far."""
        levels = self._stored.scene_levels(pixels)
        if levels is not None:
            return levels
        self._say_once("running", _RUNNING)
        return self._seen.scene()


_RUNNING = (
    "weights are normalised over the views seen so far, a running estimate; legs precompute --preset legs-robust knows "
    "all views from the first step"
)


def _is_range(weight: Tensor) -> bool:
    return weight.dim() == 2
