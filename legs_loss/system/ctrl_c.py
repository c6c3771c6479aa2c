"""Delay Ctrl-C over steps that belong together; it is never lost."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import contextmanager
from typing import Callable, Iterator, List

_RAISES = hasattr(signal, "raise_signal")  # from Python 3.8 on


@contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """Record Ctrl-C instead of raising it: yield a function that returns whether it was pressed.

    Elsewhere than in the main thread, which alone gets Ctrl-C, or where it is ignored, nothing is done.
    """
    struck: List[int] = []  # no Event: its lock would wait for itself where Ctrl-C is struck twice
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield lambda: False
        return
    signal.signal(signal.SIGINT, lambda number, _: struck.append(number))
    try:
        yield lambda: bool(struck)
    finally:
        signal.signal(signal.SIGINT, before if before is not None else signal.SIG_DFL)


@contextmanager
def held_back() -> Iterator[Callable[[], bool]]:
    """Delay Ctrl-C over a few steps that belong together; it is raised right after them.

    Yields:
        A function that returns whether it was pressed.
    """
    struck: Callable[[], bool] = bool
    try:
        with noted() as struck:
            yield struck
    finally:
        if struck():
            signal.raise_signal(signal.SIGINT) if _RAISES else os.kill(os.getpid(), signal.SIGINT)
