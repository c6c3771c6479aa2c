"""Ctrl-C over steps that belong together, and in processes that this one starts: held back, never lost."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import contextmanager
from typing import Iterator, List

try:
    from multiprocessing.resource_tracker import ensure_running
except ImportError:  # Python 3.7's name
    from multiprocessing.semaphore_tracker import ensure_running  # type: ignore[no-redef]

__all__ = ["held_back", "kept_from_children"]


@contextmanager
def kept_from_children() -> Iterator[None]:
    """Hold Ctrl-C back while processes are started: they never get one, this process gets it right afterwards.

    Where signals cannot be held back, on Windows, it is ignored meanwhile.
    """
    if hasattr(signal, "pthread_sigmask"):
        ensure_running()  # started by the first process, it would let signals through again
        held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield  # the mask is inherited, for good
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, held)
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def held_back() -> Iterator[None]:
    """Hold Ctrl-C back over a few steps that belong together; it strikes right after them.

    Elsewhere than in the main thread, which alone gets Ctrl-C, nothing is done.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    struck: List[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: struck.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before if before is not None else signal.SIG_DFL)
        if struck:
            signal.raise_signal(signal.SIGINT) if hasattr(signal, "raise_signal") else os.kill(os.getpid(), struck[0])
