"""The state of this process's run: its settings, the sources of its weights, its counts and its messages."""

from __future__ import annotations

import atexit
import os
import sys
import threading
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Deque, List, Optional, Set, Union

from legs_loss.config import Config, find_config
from legs_loss.counting import Counts, counted, note_graph, reset_counts, say_first
from legs_loss.errors import LegsError
from legs_loss.runtime.memo import DEFAULT_LIMIT
from legs_loss.runtime.sources import MASK, NOT_IN_A_GRAPH, WeightSource
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.system import say

__all__ = [
    "Run",
    "active",
    "configure",
    "counted",
    "counts",
    "current_run",
    "refuse_masks",
    "reset",
    "reset_counts",
    "spec_to_compile",
    "thread",
    "version",
]


class Run:
    """A training run.

    Attributes:
        config: its settings.
        source: where its weights come from.
    """

    def __init__(self, config: Config, memo_bytes: int = DEFAULT_LIMIT) -> None:
        self.config = config
        self.source: WeightSource = WeightSource(config, memo_bytes, counted, self.say_once)
        self._said: Set[str] = set()
        for note in config.notes:
            self.say_once(note, note)

    @property
    def active(self) -> bool:
        """Return whether anything is weighted or masked."""
        return self.config.active or (not self.config.off and self.source.has_own())

    def say_once(self, kind: str, message: str) -> None:
        """Print a line on stderr, once for each kind of message."""
        if kind not in self._said:
            self._said.add(kind)
            say(f"legs-loss: {message}", sys.stderr)

    def say_what_is_used(self) -> None:
        """Print, once on rank 0, the settings and the sources of the first step's weights, when they are known."""
        if "active" in self._said:
            return
        self._said.add("active")
        spec = self.config.spec
        if not self.active:
            off = f"LEGS_OFF={os.environ.get('LEGS_OFF', '')}"
            beta = f"preset {self.config.preset}, beta {spec.beta:g}; settings from {self.config.source}"
            say_first(f"L1 plain: {off if self.config.off else beta}")
            return
        if spec.unweighted:
            weights = f"own maps from {self.config.store}"
        elif counted.stored == 0:
            weights = "weights computed from the training images"
        elif counted.computed == 0:
            weights = f"maps from {self.config.store}"
        else:
            weights = f"maps from {self.config.store}, but for {counted.computed} image(s), whose weight is computed"
        if self.source.stored.has(MASK):
            weights += f"; masks from {self.config.store}"
            self.tell_at_end()
        say_first(
            f"L1 weighted, preset {self.config.preset}: {spec.operator}, {spec.curve}, beta {spec.beta:g}; {weights}; "
            f"settings from {self.config.source}",
        )

    def tell_at_end(self) -> None:
        """Have the process's last line say what the masks of this run were used for."""
        if not _masked or _masked[-1] is not self:
            _masked.append(self)


class _Thread(threading.local):
    """The number of calls of `unweighted` functions that a thread is in."""

    def __init__(self) -> None:
        self.unweighted = 0  # on the instance: torch.compile does not read class attributes again


thread: _Thread = _Thread()
version: List[int] = [0]  # how often the settings were replaced; compiled code is recompiled then
_run: Optional[Run] = None
_masked: Deque[Run] = deque(maxlen=1)  # the last run with masks
_lock = threading.RLock()


def current_run() -> Run:
    """Return this process's run; its settings are read at the first call."""
    global _run
    if _run is None:
        with _lock:
            if _run is None:
                _run = Run(find_config(_main_file()))
    return _run


@atexit.register
def _say_masked() -> None:
    """Print, as the process ends, what the masks of its last run were used for."""
    if _masked:
        masked, in_l1_alone = _masked[-1].source.stored.masked, counted.masked > 0 and counted.hidden == 0
        say(f"legs-loss: {masked.summary(counted.unmasked, in_l1_alone)}", sys.stderr)


def refuse_masks(version: int) -> None:
    """Raise a LegsError where a graph is compiled, and the store has masks or weights of the user's."""
    run = current_run()
    if not run.config.off and run.source.has_own():
        raise LegsError(NOT_IN_A_GRAPH)


def spec_to_compile(version: int) -> Optional[WeightSpec]:
    """Return the spec of a compiled call, None without a weight."""
    refuse_masks(version)
    run = current_run()
    run.say_what_is_used()
    if run.config.active:
        note_graph(version)
    return run.config.spec if run.config.active else None


# torch.compile calls them while it traces, and takes what they return as a constant: it cannot trace a lock, or a file
# that is read. What torch.compiler.assume_constant_result would set, without the seconds of importing the compiler.
for _constant in (refuse_masks, spec_to_compile):
    _constant._dynamo_marked_constant = True  # type: ignore[attr-defined]


def reset() -> None:
    """Reset to the state of a new process: the next call reads the settings again, and all counts are 0."""
    global _run
    with _lock:
        _run = None
        _masked.clear()
        version[0] += 1
        reset_counts()


def configure(
    spec: Optional[Spec] = None,
    store: Union[str, Path, None] = None,
    memo_bytes: int = DEFAULT_LIMIT,
) -> None:
    """Set what ``l1_loss`` uses in this process, in place of legs.toml; LEGS_OFF still turns it off.

    Args:
        spec: a preset's name or a spec; None keeps what legs.toml and the environment say.
        store: a folder that ``legs precompute`` made.
        memo_bytes: how much memory remembered weight maps may take.

    Raises:
        LegsError: an unknown preset, or settings elsewhere that are out of range.

    Examples:
        >>> configure("legs-l")
        >>> configure(replace(as_spec("legs"), curve="C5", beta=4.0))
        >>> configure("legs")
    """
    global _run
    config = find_config(_main_file())
    if spec is not None:
        config = replace(
            config,
            spec=as_spec(spec),
            preset=spec if isinstance(spec, str) else "own spec",
            source="configure()",
        )
    if store is not None:
        config = replace(config, store=Path(store))
    with _lock:
        _run = Run(config, memo_bytes)
        version[0] += 1


def active() -> bool:
    """Return whether ``l1_loss`` weights or masks what is trained: not with beta 0 alone, nor with LEGS_OFF.

    Raises:
        LegsError: a setting in legs.toml or LEGS_* that is out of range.
    """
    return current_run().active


def counts() -> Counts:
    """Return a copy of this process's counts so far."""
    return replace(counted)


def _main_file() -> Path:
    path = getattr(sys.modules.get("__main__"), "__file__", None)
    return Path(path) if path else Path.cwd()
