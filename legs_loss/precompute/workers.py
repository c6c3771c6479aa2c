"""Share tasks out to processes of this machine, as ``system.executors`` does to a cluster's."""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing.connection import wait
from typing import Any, Dict, Generator, Sequence, Tuple

import torch

from legs_loss.errors import LegsError
from legs_loss.system import Child
from legs_loss.system.executors import Listener, Task

_PATIENCE = 5.0  # seconds; a process that is killed leaves numba's semaphore behind, and Python warns
# The memory of a photograph of up to 16 megapixels in one piece, and kept for the next one: mapping new memory took a
# quarter of the decoding.
_PILLOW = {"PILLOW_BLOCK_SIZE": "64m", "PILLOW_BLOCKS_MAX": "2"}


def in_processes(
    task: Task, arguments: Sequence[Any], workers: int, listen: Listener = lambda message: None
) -> Generator[Tuple[Any, Any], None, None]:
    """Yield each argument with the result of its task, or the LegsError that this ended in, in the order they end.

    Each process has one thread, one task at a time and a pipe of its own: one that dies costs one task, and when this
    process dies, they find their pipes closed and end.

    Args:
        task: what is run, of an argument and of what it tells meanwhile.
        arguments: of the tasks.
        workers: processes.
        listen: gets what all tasks tell.
    """
    waiting = list(reversed(arguments))
    crew: Dict[Any, Tuple[Child, Any]] = {}  # by this side's end of their pipes

    def give(worker: Child) -> None:
        argument = waiting.pop()
        crew[worker.connection] = worker, argument
        with suppress(OSError):  # it died; its pipe will say so
            worker.connection.send(argument)

    try:
        for _ in range(min(workers, len(arguments))):
            give(Child(_work, task))
        while crew:
            for connection in wait(list(crew)):
                worker, argument = crew[connection]
                try:
                    ended, message = worker.connection.recv()
                except (EOFError, OSError):
                    ended, message = True, LegsError("its process was killed (out of memory?)")
                    worker.end()
                    worker = Child(_work, task) if waiting else worker
                if not ended:
                    listen(message)
                    continue
                del crew[connection]
                if waiting:
                    give(worker)
                else:
                    worker.end(_PATIENCE)
                yield argument, message
    finally:
        for worker, _ in crew.values():
            worker.end()


def _work(connection: Any, task: Task) -> None:
    """Run tasks until the parent has ended."""
    if not any(name in os.environ for name in _PILLOW):
        os.environ.update(_PILLOW)  # before Pillow is imported, which reads them
    torch.set_num_threads(1)
    with suppress(EOFError, OSError):
        while True:
            argument = connection.recv()
            try:
                result = task(argument, lambda message: connection.send((False, message)))
            except LegsError as error:
                result = error
            except OSError as error:  # a full disk is no fault of the code either
                result = LegsError(str(error))
            connection.send((True, result))
