"""Counts of what the losses of this process did, and the lines that say whether its training is weighted."""

from __future__ import annotations

import atexit
import os
import sys
from dataclasses import dataclass
from multiprocessing import util
from typing import Any, Callable, Set

from legs_loss.system.terminal import is_first_process, say


@dataclass
class Counts:
    """Counts of this process's calls of the losses, and of the sources of the weights of ``l1_loss``.

    Attributes:
        weighted: calls that trained with a weight.
        plain: calls of ``l1_loss`` without one: no gradient asked for, beta 0, LEGS_OFF, or `unweighted`.
        plain_steps: calls that trained without a weight.
        graphs: graphs of torch.compile that train with a weight; their steps are not counted.
        remembered: images whose weight was taken from the memo.
        stored: images whose weight map was taken from the store.
        computed: images whose weight was computed from them.
        masked: images whose L1 was the mean over what a mask of the store counts.
        unmasked: images of the L1 that were not found in a store with masks, and counted whole.
        hidden: renderings whose masked pixels were hidden from the other terms, by `masked` or `LEGSLoss`.
    """

    weighted: int = 0
    plain: int = 0
    plain_steps: int = 0
    graphs: int = 0
    remembered: int = 0
    stored: int = 0
    computed: int = 0
    masked: int = 0
    unmasked: int = 0
    hidden: int = 0


counted: Counts = Counts()
said: Set[str] = set()  # the line of the first training step, when it was said


def reset_counts() -> None:
    """Set all counts to 0."""
    vars(counted).update(vars(Counts()))
    said.clear()


def say_first(message: str) -> None:
    """Print what the process's first training step is, once, on rank 0."""
    if not said:
        said.add(message)
        if is_first_process():
            say(f"legs-loss: {message}", sys.stderr)


def note_graph() -> None:
    """Count a graph of torch.compile with a weight."""
    counted.graphs += 1


note_graph._dynamo_marked_constant = True  # type: ignore[attr-defined]  # called while a graph is traced, not in it


def _took_gradients() -> bool:
    """Return whether a loss of ours trained here, or else an optimiser and a graph of autograd were made."""
    if counted.weighted or counted.plain_steps or counted.graphs:
        return True
    torch = sys.modules.get("torch")
    if torch is None or not hasattr(torch, "optim") or _nodes() == _begun:
        return False
    made, kinds = False, [torch.optim.Optimizer]
    while kinds and not made:  # torch marks the class of an optimiser that is made
        kind = kinds.pop()
        made = bool(getattr(kind.__dict__.get("step"), "hooked", False))
        kinds += kind.__subclasses__()
    return made


_begun = 0  # what _nodes() returned as the process began


def _nodes() -> int:
    """Return how many nodes autograd has made, -1 where it does not say."""
    autograd: Any = getattr(getattr(sys.modules.get("torch"), "_C", None), "_autograd", None)
    return getattr(autograd, "_get_sequence_nr", lambda: -1)()


def _begin_again() -> None:
    """Count what a forked process does alone."""
    global _begun
    _begun = _nodes()
    reset_counts()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_again)


def at_end(function: Callable[[], None]) -> Callable[[], None]:
    """Have a function called once as the process ends; atexit does not in one that multiprocessing has forked."""

    def once() -> None:
        atexit.unregister(once)
        function()

    atexit.register(once)
    util.register_after_fork(once, lambda once: util.Finalize(None, once, exitpriority=0))
    return function


@at_end
def _say_last() -> None:
    """Print, as a process ends that took gradients, how many of its steps were weighted; on rank 0."""
    if not (_took_gradients() and is_first_process()):
        return
    graphs = f"{counted.graphs} compiled graph(s) weighted, whose steps are not counted" if counted.graphs else ""
    if counted.weighted:
        line = f"{counted.weighted} step(s) weighted, {counted.plain_steps} plain with a gradient"
        line += f"; {graphs}" if graphs else ""
    else:
        line = graphs or "no L1 was weighted in this run"
        line += f": {counted.plain_steps} plain step(s) with a gradient" if counted.plain_steps else ""
    say(f"legs-loss: {line}", sys.stderr)
