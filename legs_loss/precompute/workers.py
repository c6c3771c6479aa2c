"""Distribute views to processes, each with one photograph in memory at a time."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Dict, Generator, Iterator, Sequence

import torch

from legs_loss.errors import LegsError
from legs_loss.precompute.one_view import Job, Result, Task, make
from legs_loss.precompute.photograph import compiled_anew, compiles
from legs_loss.scenes import image_size
from legs_loss.system import kept_from_children

__all__ = ["in_processes"]

_PATIENCE = 5.0  # seconds; a process that is killed leaves numba's semaphore behind, and Python warns
# The memory of a photograph of up to 16 megapixels in one piece, and kept for the next one.
_PILLOW = {"PILLOW_BLOCK_SIZE": "64m", "PILLOW_BLOCKS_MAX": "2"}


def in_processes(job: Job, tasks: Sequence[Task], workers: int) -> Generator[Result, None, None]:
    """Yield the results of worker processes, in the order they come.

    Each worker has one task at a time and a pipe of its own: a worker that dies costs one view, and when this process
    dies, the workers find their pipes closed and end.
    """
    waiting = list(reversed(tasks))
    crew: Dict[Any, _Worker] = {}  # by this side's end of their pipes

    def give(worker: _Worker) -> None:
        worker.task = waiting.pop()
        crew[worker.connection] = worker
        with suppress(OSError):  # it died; its pipe will say so
            worker.connection.send(worker.task)

    try:
        for _ in range(min(workers, len(tasks))):
            give(_Worker(job))
        while crew:
            for connection in wait(list(crew)):
                worker = crew.pop(connection)
                try:
                    result = worker.connection.recv()
                    if result is None:  # it compiled, see `_work`
                        waiting.append(worker.task)
                        worker.end(_PATIENCE)
                        give(_Worker(job, compiles=False))
                        continue
                except (EOFError, OSError):
                    reason = f"{worker.task.view.path}: the process that read it was killed (out of memory?)"
                    result = Result(worker.task.view.name, problem=reason)
                    worker.end()
                    worker = _Worker(job) if waiting else worker
                if waiting:
                    give(worker)
                else:
                    worker.end(_PATIENCE)
                yield result
    finally:
        for worker in crew.values():
            worker.end()


class _Worker:
    """A process that makes maps, and this side's end of its pipe."""

    task: Task

    def __init__(self, job: Job, compiles: bool = True) -> None:
        context = multiprocessing.get_context("spawn")  # forked, it would inherit locks and threads
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, job, compiles), daemon=True)
        with kept_from_children(), _kept_blocks():
            self.process.start()
        theirs.close()

    def end(self, patience: float = 0.0) -> None:
        """Close its pipe, which ends it when it is idle; after some seconds it is killed."""
        self.connection.close()
        self.process.join(patience)
        self.process.terminate()
        self.process.join()


@contextmanager
def _kept_blocks() -> Iterator[None]:
    """Let Pillow, in processes started meanwhile, keep the memory of a photograph for the next.

    Mapping new memory took a quarter of the decoding. The user's own settings are kept.
    """
    if any(name in os.environ for name in _PILLOW):
        yield
        return
    os.environ.update(_PILLOW)
    try:
        yield
    finally:
        for name in _PILLOW:
            del os.environ[name]


def _work(connection: Any, job: Job, compiles: bool) -> None:
    """Make maps; if the first one needs code that is not compiled yet, only compile it.

    The compiler keeps nearly 200 MB, so None is sent then, and another process loads the compiled code.
    """
    torch.set_num_threads(1)
    try:
        task = connection.recv()
        if compiles and _is_large(task.view.path) and compiled_anew(job.spec):
            connection.send(None)
            return
        while True:
            connection.send(make(job, task))
            task = connection.recv()
    except (EOFError, OSError):  # the parent has ended
        pass


def _is_large(path: Path) -> bool:
    with suppress(LegsError, OSError):
        width, height = image_size(path)
        return compiles(3 * width * height)
    return False
