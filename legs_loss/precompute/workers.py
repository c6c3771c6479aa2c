"""Distribute views to processes, each with one photograph in memory at a time."""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing.connection import wait
from typing import Any, Dict, Generator, Sequence, Tuple

import torch

from legs_loss.precompute.one_view import Job, ViewResult, ViewTask, make
from legs_loss.system import Child

__all__ = ["in_processes"]

_PATIENCE = 5.0  # seconds; a process that is killed leaves numba's semaphore behind, and Python warns
# The memory of a photograph of up to 16 megapixels in one piece, and kept for the next one: mapping new memory took a
# quarter of the decoding.
_PILLOW = {"PILLOW_BLOCK_SIZE": "64m", "PILLOW_BLOCKS_MAX": "2"}


def in_processes(job: Job, tasks: Sequence[ViewTask], workers: int) -> Generator[ViewResult, None, None]:
    """Yield the results of worker processes, in the order they come.

    Each worker has one task at a time and a pipe of its own: a worker that dies costs one view, and when this process
    dies, the workers find their pipes closed and end.
    """
    waiting = list(reversed(tasks))
    crew: Dict[Any, Tuple[Child, ViewTask]] = {}  # by this side's end of their pipes

    def give(worker: Child) -> None:
        task = waiting.pop()
        crew[worker.connection] = worker, task
        with suppress(OSError):  # it died; its pipe will say so
            worker.connection.send(task)

    try:
        for _ in range(min(workers, len(tasks))):
            give(Child(_work, job))
        while crew:
            for connection in wait(list(crew)):
                worker, task = crew.pop(connection)
                try:
                    result = worker.connection.recv()
                except (EOFError, OSError):
                    reason = f"{task.view.path}: the process that read it was killed (out of memory?)"
                    result = ViewResult(task.view.name, problem=reason)
                    worker.end()
                    worker = Child(_work, job) if waiting else worker
                if waiting:
                    give(worker)
                else:
                    worker.end(_PATIENCE)
                yield result
    finally:
        for worker, _ in crew.values():
            worker.end()


def _work(connection: Any, job: Job) -> None:
    """Make maps until the parent has ended."""
    if not any(name in os.environ for name in _PILLOW):
        os.environ.update(_PILLOW)  # before Pillow is imported, which reads them
    torch.set_num_threads(1)
    with suppress(EOFError, OSError):
        while True:
            connection.send(make(job, connection.recv()))
