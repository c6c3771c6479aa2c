"""Ctrl-C and the processes that this one starts: it is the parent's to handle, and it is never lost."""

from __future__ import annotations

import signal
from contextlib import contextmanager
from typing import Iterator

try:
    from multiprocessing.resource_tracker import ensure_running
except ImportError:  # Python 3.7's name
    from multiprocessing.semaphore_tracker import ensure_running  # type: ignore[no-redef]

__all__ = ["kept_from_children"]


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
