"""Find the weight of a target: in the memo, in the store, or from the target itself, in this order.

The memo has targets that are provably unchanged. The store is used for exactly the image that its map was made from, by
the target's fingerprint. In all other cases the weight is computed: a backend needs two numbers of the target, the
least response and the span; torch needs the map.
"""

from __future__ import annotations

from functools import partial
from typing import Callable, List, NamedTuple, Optional, Sequence, Union

import torch
from torch import Tensor

from legs_loss.config import Config
from legs_loss.counting import Counts
from legs_loss.errors import LegsError
from legs_loss.images import is_transformed
from legs_loss.kernels.available import is_capturing
from legs_loss.kernels.backends import fused_range
from legs_loss.runtime.call import Call
from legs_loss.runtime.memo import WeightMemo
from legs_loss.runtime.stored import Stored, Whole
from legs_loss.weights import Weights, weight_map

__all__ = ["MASK", "NOT_IN_A_GRAPH", "WEIGHTS", "WeightSource"]

MASK, WEIGHTS = "mask", "weights"  # the store's names of the user's own maps; it is imported only where there is one
NOT_IN_A_GRAPH = (
    "the store has masks or weights of your own, which are found by the image, and a compiled or captured graph, "
    "torch.func and forward-mode AD cannot look: leave the loss out of them, or name a store without (LEGS_STORE)"
)


class Range(NamedTuple):
    """The least response of an image and the span, [1, 2], that a backend makes its weights of."""

    values: Tensor


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
        self.stored: Stored = Stored(config, say_once)

    def weights(self, call: Call) -> Weights:
        """Return the weights of a call's target, with the user's own, and count their sources."""
        names = call.view_names()
        weights = Weights() if self.config.spec.unweighted else self._made_weights(call, names)
        own = self.own(call.target, names, WEIGHTS)
        mask = self.own(call.target, names, MASK, counted=True)
        return weights.times(own).masked(mask)

    def has_own(self) -> bool:
        """Return whether the store has masks or weights of the user's, which hold for every preset."""
        return self.stored.has(MASK) or self.stored.has(WEIGHTS)

    def own(self, target: Tensor, names: Sequence[Optional[str]], kind: str, counted: bool = False) -> Optional[Tensor]:
        """Return the user's masks or weights of a target, [1, H, W] or [B, 1, H, W]; None where all counts whole.

        Raises:
            LegsError: they cannot be looked up in a CUDA graph; or as :meth:`Stored.own`.
        """
        if not self.stored.has(kind):
            return None
        if is_transformed() or is_capturing(target.device):
            raise LegsError(NOT_IN_A_GRAPH)
        maps = [
            self.memo.recall(image, partial(self.stored.own, image, name, kind), kind)
            for image, name in zip(_images(target), names)
        ]
        if counted:
            self._counts.masked += sum(isinstance(one, Tensor) for one in maps)
            self._counts.unmasked += sum(one is Whole.UNKNOWN for one in maps)
        if not any(isinstance(one, Tensor) for one in maps):
            return None
        ones = torch.ones((1, *target.shape[-2:]), device=target.device)
        whole = [one if isinstance(one, Tensor) else ones for one in maps]
        return whole[0] if target.dim() == 3 else torch.stack(whole)

    def _made_weights(self, call: Call, names: Sequence[Optional[str]]) -> Weights:
        images = _images(call.target)
        found = [self._weight(image, name, call) for image, name in zip(images, names)]
        spec = self.config.spec
        ranges = [one.values for one in found if isinstance(one, Range)]
        if len(ranges) == len(found):
            return Weights(spec=spec, range=torch.cat(ranges))
        maps = [one if isinstance(one, Tensor) else weight_map(image, spec, False) for image, one in zip(images, found)]
        return Weights(map=maps[0] if call.target.dim() == 3 else torch.stack(maps))

    def _weight(self, image: Tensor, view: Optional[str], call: Call) -> Union[Tensor, Range]:
        """Return an image's weight map [1, H, W], or the range that makes it."""
        counts = self._counts
        if is_transformed() or is_capturing(image.device):
            # A CUDA graph is replayed with other pixels in the target's memory: their weight is part of the graph.
            counts.computed += 1
            return self._computed(image, call)
        if call.is_mean() and image.device.type == "cpu" and self.config.store is None:
            # Here a SHA-256 of an image's bytes takes longer than its range.
            found = fused_range(image, self.config.spec)
            if found is not None:
                counts.computed += 1
                return Range(found)
        before = counts.stored + counts.computed
        weight = self.memo.recall(image, lambda: self._made(image, view, call), call.is_mean())
        counts.remembered += counts.stored + counts.computed == before
        return weight

    def _made(self, image: Tensor, view: Optional[str], call: Call) -> Union[Tensor, Range]:
        weight = self.stored.weight(image, view)
        if weight is not None:
            self._counts.stored += 1
            return weight
        self._counts.computed += 1
        return self._computed(image, call)

    def _computed(self, image: Tensor, call: Call) -> Union[Tensor, Range]:
        spec = self.config.spec
        if spec.over == "scene":
            return weight_map(image, spec, False, self.stored.scene_levels(image.shape[-2] * image.shape[-1]))
        found = fused_range(image, spec) if call.is_mean() else None
        return weight_map(image, spec, False) if found is None else Range(found)


def _images(target: Tensor) -> List[Tensor]:
    return [target] if target.dim() == 3 else list(target)
