"""The seconds of a step: the processor's own on one thread, the clock's on several, a GPU's own between two events."""

from __future__ import annotations

import statistics
import time
from typing import Any, Callable, List, Optional

import torch

__all__ = ["COPIED", "FASTEST_CLOCK", "STEPS", "as_launched", "between_events", "copy_bandwidth", "timed"]

STEPS = 10  # between two events of a GPU
LONGEST_WAIT = 1.0  # seconds
FASTEST_CLOCK = 3e9  # of any GPU, in cycles a second: a slower one waits longer
COPIED = 1 << 28  # bytes


def timed(step: Callable[[], Any], device: torch.device, launched: Optional[List[float]] = None) -> float:
    """Return the seconds of a step: on one thread the processor's own, which other people's work hardly changes.

    launched: gets the seconds of a GPU's step as Python launches it.
    """
    if device.type == "cuda":
        step()  # what is compiled or allocated now is not timed
        by_python = as_launched(step, device)
        if launched is not None:
            launched.append(by_python)
        return between_events(step, by_python)
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    before = clock()
    step()
    return clock() - before


def as_launched(step: Callable[[], Any], device: torch.device) -> float:
    """Return the seconds of a step on a GPU as Python launches it: of a small image, launching takes longest."""
    torch.cuda.synchronize(device)
    before = time.perf_counter()
    for _ in range(STEPS):
        step()
    torch.cuda.synchronize(device)
    return (time.perf_counter() - before) / STEPS


def between_events(step: Callable[[], Any], launched: float) -> float:
    """Return the seconds of a step on a GPU alone: the GPU is kept busy until all steps are launched, then timed."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda._sleep(int(min(2.0 * launched * STEPS, LONGEST_WAIT) * FASTEST_CLOCK))
    start.record()
    for _ in range(STEPS):
        step()
    end.record()
    end.synchronize()
    return start.elapsed_time(end) / 1e3 / STEPS


def copy_bandwidth(device: torch.device) -> float:
    """Return how many bytes a second a copy on the device moves, read and written."""
    source = torch.empty(COPIED, dtype=torch.uint8, device=device)
    copy = torch.empty_like(source)
    return 2 * COPIED / statistics.median(timed(lambda: copy.copy_(source), device) for _ in range(9))
