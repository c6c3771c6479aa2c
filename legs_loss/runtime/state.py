"""The run of this process: its settings, its messages, and the weight of a target.

A weight is found in the memo, in the store, or made from the target itself, in this order. The memo has targets that
are provably unchanged. The store is used for exactly the image that its map was made from, by the target's fingerprint.
In all other cases the weight is computed: a backend needs two numbers of the target, the least response and the span;
torch needs the map.
"""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Deque, Dict, List, Optional, Sequence, Set, Union

import torch
from torch import Tensor

from legs_loss.autograd import is_differentiated, is_in_a_node, is_transformed
from legs_loss.config import Config, find_config, store_folder
from legs_loss.counting import Counts, at_end, counted, note_graph, reset_counts, say_first
from legs_loss.errors import LegsError
from legs_loss.images import shape_of
from legs_loss.kernels.available import is_capturing
from legs_loss.kernels.backends import fused_range
from legs_loss.runtime.memo import DEFAULT_LIMIT, WeightMemo
from legs_loss.runtime.stored import Stored, Whole
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.system.terminal import say
from legs_loss.weights import Weights, weight_map

MASK, WEIGHTS = "mask", "weights"  # the store's names of the user's own maps; it is imported only where there is one
_NOT_IN_A_GRAPH = (
    "the store has masks or weights of your own, which are found by the image, and a compiled or captured graph, "
    "torch.func and forward-mode AD cannot look: leave the loss out of them, or name a store without (LEGS_STORE)"
)

ViewName = Union[str, int, Sequence[Union[str, int]], None]


class TrainingRun:
    """A training run.

    Args:
        config: its settings.
        memo_bytes: how much memory the memo may take.

    Attributes:
        weighted: whether the settings weight anything; the store may do so besides.
        computes: whether nothing is looked up for images on the CPU. Without a store, a SHA-256 of an image's bytes
            takes longer than its range.
        said: whether the first step's line was printed.
    """

    def __init__(self, config: Config, memo_bytes: int = DEFAULT_LIMIT) -> None:
        self.config = config
        self.weighted: bool = not (config.off or config.spec.unweighted)
        self.computes: bool = config.store is None and not config.require_masks
        self.said: bool = False
        self.memo: WeightMemo = WeightMemo(memo_bytes)
        self.stored: Stored = Stored(config, self.say_once)
        self._said: Set[str] = set()
        for note in config.notes:
            self.say_once(note, note)

    @property
    def active(self) -> bool:
        """Return whether anything is weighted or masked."""
        return self.weighted or (not self.config.off and self.has_users_maps())

    def has_users_maps(self) -> bool:
        """Return whether the store has masks or weights of the user's, which hold for every preset."""
        return self.stored.has(MASK, WEIGHTS)

    def weights(self, target: Tensor, view: ViewName, made: bool) -> Weights:
        """Return the weights of a target [C, H, W] or [B, C, H, W], with the user's own, and count their sources.

        Args:
            target: the photographs.
            view: the name of each, as for :func:`~legs_loss.l1_loss`.
            made: a backend makes the weights of the run's spec by itself, and needs no map in memory for them.

        Raises:
            LegsError: another number of names than of images, or a name that is no text or number; :meth:`users_map`.
        """
        count = 1 if target.dim() == 3 else target.shape[0]
        names = [None] * count if view is None else _names(view, target, count)
        if made and self.computes and target.device.type == "cpu":
            counted.computed += count
            return Weights(self.config.spec)
        if view is None and target.dim() == 3 and self.weighted and (self.computes or not self.has_users_maps()):
            found = self._weight(target, None, made)
            return found if isinstance(found, Weights) else Weights(map=found)
        images = [target] if target.dim() == 3 else list(target)
        weights = Weights() if self.config.spec.unweighted else self._made_weights(images, names, made)
        mask = self.users_map(target, MASK, names)
        return weights.times(self.users_map(target, WEIGHTS, names)).masked(mask)

    def users_map(self, target: Tensor, kind: str, names: Sequence[Optional[str]] = ()) -> Optional[Tensor]:
        """Return the user's masks or weights of a target, [1, H, W] or [B, 1, H, W]; None where all counts whole.

        Args:
            target: the photographs.
            kind: MASK or WEIGHTS.
            names: of the views, for messages. With them what was found is counted.

        Raises:
            LegsError: they cannot be looked up in a CUDA graph; or as :meth:`Stored.users_map`.
        """
        if not self.stored.has(kind):
            return None
        if is_transformed() or is_capturing(target.device):
            raise LegsError(_NOT_IN_A_GRAPH)
        images = [target] if target.dim() == 3 else list(target)
        maps = [
            self.memo.recall(image, partial(self.stored.users_map, image, name, kind), kind)
            for image, name in zip(images, names or [None] * len(images))
        ]
        if kind == MASK and names:
            counted.masked += sum(isinstance(one, Tensor) for one in maps)
            counted.unmasked += sum(one is Whole.UNKNOWN for one in maps)
        if not any(isinstance(one, Tensor) for one in maps):
            return None
        ones = torch.ones((1, *target.shape[-2:]), device=target.device)
        whole = [one if isinstance(one, Tensor) else ones for one in maps]
        return whole[0] if target.dim() == 3 else torch.stack(whole)

    def _made_weights(self, images: List[Tensor], names: Sequence[Optional[str]], made: bool) -> Weights:
        found = [self._weight(image, name, made) for image, name in zip(images, names)]
        spec = self.config.spec
        ranges = [one.range for one in found if isinstance(one, Weights)]
        if len(ranges) == len(found):
            return Weights(spec, torch.cat(ranges))  # type: ignore[arg-type]  # each has one
        maps = [one if isinstance(one, Tensor) else weight_map(image, spec, False) for image, one in zip(images, found)]
        return Weights(map=torch.stack(maps))

    def _weight(self, image: Tensor, view: Optional[str], made: bool) -> Union[Tensor, Weights]:
        """Return an image's weight map [1, H, W], or its spec and the range that a backend makes its weights of."""
        if is_transformed() or is_capturing(image.device):
            # A CUDA graph is replayed with other pixels in the target's memory: their weight is part of the graph.
            return self._computed(image, made)
        before = counted.stored + counted.computed
        weight = self.memo.recall(image, partial(self._made, image, view, made), made)
        counted.remembered += counted.stored + counted.computed == before
        return weight

    def _made(self, image: Tensor, view: Optional[str], made: bool) -> Union[Tensor, Weights]:
        weight = self.stored.weight(image, view)
        if weight is not None:
            counted.stored += 1
            return weight
        return self._computed(image, made)

    def _computed(self, image: Tensor, made: bool) -> Union[Tensor, Weights]:
        spec = self.config.spec
        counted.computed += 1
        if spec.over == "scene":
            return weight_map(image, spec, False, self.stored.scene_levels(image.shape[-2] * image.shape[-1]))
        found = fused_range(image, spec) if made else None
        return weight_map(image, spec, False) if found is None else Weights(spec, found)

    def say_once(self, kind: str, message: str) -> None:
        """Print a line on stderr, once for each kind of message."""
        if kind not in self._said:
            self._said.add(kind)
            say(f"legs-loss: {message}", sys.stderr)

    def say_what_is_used(self) -> None:
        """Print, once on rank 0, the settings and the sources of the first step's weights, when they are known."""
        if self.said:
            return
        self.said, spec = True, self.config.spec
        if not self.active:
            off = f"LEGS_OFF={os.environ.get('LEGS_OFF', '')}"
            beta = f"preset {self.config.preset}, beta {spec.beta:g}; settings from {self.config.source}"
            return say_first(f"L1 plain: {off if self.config.off else beta}")
        if spec.unweighted:
            weights = f"own maps from {self.config.store}"
        elif counted.stored == 0:
            weights = "weights computed from the training images"
        elif counted.computed == 0:
            weights = f"maps from {self.config.store}"
        else:
            weights = f"maps from {self.config.store}, but for {counted.computed} image(s), whose weight is computed"
        if self.stored.has(MASK):
            weights += f"; masks from {self.config.store}"
            self.tell_at_end()
        made = f"preset {self.config.preset}: {spec.operator}, {spec.curve}, beta {spec.beta:g}"
        say_first(f"L1 weighted, {made}; {weights}; settings from {self.config.source}")

    def tell_at_end(self) -> None:
        """Have the process's last line say what the masks of this run were used for."""
        _masked.append(self)


class _Thread(threading.local):
    """The number of calls of `unweighted` functions that a thread is in."""

    def __init__(self) -> None:
        self.unweighted = 0  # on the instance: torch.compile does not read class attributes again


thread: _Thread = _Thread()
generation: int = 0  # how often the settings were replaced; compiled code is recompiled then
_runs: Dict[int, TrainingRun] = {}  # the run of this generation
_masked: Deque[TrainingRun] = deque(maxlen=1)  # the last run with masks
_lock = threading.RLock()


def current_run() -> TrainingRun:
    """Return this process's run; its settings are read at the first call."""
    return _runs.get(generation) or _run_of(generation)


def _run_of(number: int) -> TrainingRun:
    with _lock:
        if number not in _runs:
            _runs[number] = TrainingRun(find_config(_main_file()))
        return _runs[number]


@at_end
def _say_masked() -> None:
    """Print, as the process ends, what the masks of its last run were used for."""
    if _masked:
        in_l1_alone = counted.masked > 0 and counted.hidden == 0
        say(f"legs-loss: {_masked[-1].stored.summary(counted.unmasked, in_l1_alone)}", sys.stderr)


def refuse_masks(number: int) -> None:
    """Raise a LegsError where a graph is compiled, and the store has masks or weights of the user's.

    Args:
        number: the generation of the settings, for which alone the graph holds.
    """
    run = _run_of(number)
    if not run.config.off and run.has_users_maps():
        raise LegsError(_NOT_IN_A_GRAPH)


def spec_to_compile(number: int, is_trained: bool) -> Optional[WeightSpec]:
    """Return the spec of a compiled call, None without a weight.

    Args:
        number: as for :func:`refuse_masks`, whose errors it raises, too.
        is_trained: whether the prediction requires a gradient. What else may take one is an error.
    """
    run = _run_of(number)
    if not is_trained:
        if run.active and (is_differentiated() or is_in_a_node()):
            raise LegsError(
                "torch.func, forward AD, a re-entrant checkpoint or an autograd.Function with torch.compile: the graph "
                "does not show whether l1_loss is trained. Leave one of them out, or call legs_loss: always weighted"
            )
        return None
    refuse_masks(number)
    run.say_what_is_used()
    if run.weighted:
        note_graph()
    return run.config.spec if run.weighted else None


# torch.compile calls them while it traces, and takes what they return as a constant: it cannot trace a lock, or a file
# that is read. What torch.compiler.assume_constant_result would set, without the seconds of importing the compiler.
_constant: Any
for _constant in (refuse_masks, spec_to_compile):
    _constant._dynamo_marked_constant = True


def _replace(run: Optional[TrainingRun]) -> None:
    global generation
    with _lock:
        generation += 1
        _runs.clear()
        if run is not None:
            _runs[generation] = run


def reset() -> None:
    """Reset to the state of a new process: the next call reads the settings again, and all counts are 0."""
    _replace(None)
    _masked.clear()
    reset_counts()


def configure(
    spec: Optional[Spec] = None, store: Union[str, Path, None] = None, memo_bytes: int = DEFAULT_LIMIT
) -> None:
    """Set what ``l1_loss`` uses in this process, in place of legs.toml; LEGS_OFF still turns it off.

    Args:
        spec: a preset's name or a spec; None keeps what legs.toml and the environment say.
        store: a folder that ``legs precompute`` made.
        memo_bytes: how much memory remembered weight maps may take.

    Raises:
        LegsError: an unknown preset, a store that is no path, or settings elsewhere that are out of range.

    Examples:
        >>> configure("legs-l")
        >>> configure(replace(as_spec("legs"), curve="C5", beta=4.0))
        >>> configure("legs")
    """
    config = find_config(_main_file())
    if spec is not None:
        preset = spec if isinstance(spec, str) else "own spec"
        config = replace(config, spec=as_spec(spec), preset=preset, source="configure()")
    config = replace(config, store=store_folder(store, Path()) or config.store)
    if not isinstance(memo_bytes, int) or memo_bytes < 0:
        raise LegsError(f"memo_bytes must be a whole number of bytes, got {memo_bytes!r}")
    _replace(TrainingRun(config, memo_bytes))


def active() -> bool:
    """Return whether ``l1_loss`` weights or masks what is trained: not with beta 0 alone, nor with LEGS_OFF.

    Raises:
        LegsError: a setting in legs.toml or LEGS_* that is out of range.
    """
    return current_run().active


def counts() -> Counts:
    """Return a copy of this process's counts so far."""
    return replace(counted)


def _names(view: Any, target: Tensor, count: int) -> List[Optional[str]]:
    names: List[Any] = list(view) if isinstance(view, (list, tuple)) else [view]
    if len(names) != count or not all(isinstance(name, (str, int)) for name in names):
        raise LegsError(f"view must be one name a view: target {shape_of(target)} holds {count}, got {view!r}")
    return [str(name) for name in names]


def _main_file() -> Path:
    path = getattr(sys.modules.get("__main__"), "__file__", None)
    return Path(path) if path else Path.cwd()
