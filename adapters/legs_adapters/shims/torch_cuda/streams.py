"""Replace CUDA's events, streams and device contexts: work on the CPU is always finished."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Optional, Type

import torch

__all__ = ["Event", "Nowhere", "Stream"]


class Event:
    """``torch.cuda.Event`` by the wall clock."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._at = 0.0

    def record(self, stream: Any = None) -> None:
        """Record the time."""
        self._at = time.perf_counter()

    def elapsed_time(self, end_event: Event) -> float:
        """Return the milliseconds from this event to the other."""
        return 1000 * (end_event._at - self._at)

    def synchronize(self) -> None:
        """Do nothing: no work is pending."""

    def wait(self, stream: Any = None) -> None:
        """Do nothing: no work is pending."""

    def query(self) -> bool:
        """Return True: no work is pending."""
        return True


class Stream:
    """``torch.cuda.Stream``: the only one, with no work pending."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.device: torch.device = torch.device("cpu")
        self.cuda_stream = self.stream_id = 0

    def record_event(self, event: Optional[Event] = None) -> Event:
        """Return an event of now."""
        event = event or Event()
        event.record()
        return event

    def synchronize(self) -> None:
        """Do nothing: no work is pending."""

    def wait_event(self, event: Event) -> None:
        """Do nothing: no work is pending."""

    def wait_stream(self, stream: Stream) -> None:
        """Do nothing: no work is pending."""

    def query(self) -> bool:
        """Return True: no work is pending."""
        return True


class Nowhere:
    """A context, such as that of a device, that changes nothing."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __enter__(self) -> Nowhere:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        return None
