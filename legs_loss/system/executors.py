"""Run a task for each argument, in this process or on the workers of a dask scheduler.

A task is a function of a module: of an argument and of ``tell``, which sends a message (numbers, strings, lists, dicts)
to the caller. Workers need access to the task's files: the file system is shared.
"""

from __future__ import annotations

import asyncio
import logging
import platform
import uuid
from concurrent.futures import CancelledError
from typing import Any, Callable, Iterable, Iterator, Optional, Tuple

from legs_loss._version import __version__
from legs_loss.errors import LegsError, require

Listener = Callable[[Any], None]
Task = Callable[[Any, Listener], Any]
_PATIENCE = 30  # seconds for a scheduler to answer, and for its first worker


def outcomes(
    task: Task, arguments: Iterable[Any], scheduler: Optional[str], listen: Listener
) -> Iterator[Tuple[Any, Any]]:
    """Yield each argument with the result of its task, or the LegsError that this ended in, in the order they end.

    Args:
        task: what is run.
        arguments: of the tasks.
        scheduler: a dask scheduler's address ("tcp://host:8786"), whose workers run them; None runs them here, one
            after the other.
        listen: gets what all tasks tell, maybe in another thread.

    Raises:
        LegsError: dask is missing, or no scheduler or no worker answers.
    """
    if scheduler is not None:
        yield from _on_cluster(task, arguments, scheduler, listen)
        return
    for argument in arguments:
        try:
            yield argument, task(argument, listen)
        except LegsError as error:
            yield argument, error


def _on_cluster(task: Task, arguments: Iterable[Any], scheduler: str, listen: Listener) -> Iterator[Tuple[Any, Any]]:
    require("--scheduler", "cluster", "distributed")
    from distributed import Client, as_completed

    try:
        client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise LegsError(f"no dask scheduler answers at {scheduler}: {error}") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # a traceback where the scheduler goes away
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except (TimeoutError, asyncio.TimeoutError):
            raise LegsError(f"the scheduler {scheduler} has no workers: start some with `dask worker`") from None
        topic = f"legs-{uuid.uuid4().hex}"
        client.subscribe_topic(topic, lambda event: listen(event[1]))
        futures = {
            client.submit(_on_worker, __version__, task, argument, topic, pure=False): argument
            for argument in arguments
        }
        for future in as_completed(futures, loop=client.loop):
            yield futures[future], _outcome(future)


def _outcome(future: Any) -> Any:
    try:
        return future.result()
    except LegsError as error:
        return error
    except (CancelledError, asyncio.CancelledError):
        return LegsError("the scheduler went away: what was done is kept, run it again")
    except Exception as error:
        if type(error).__module__.split(".")[0] != "distributed" and not isinstance(error, ModuleNotFoundError):
            raise
        return LegsError(f"a worker could not run it: {error}")


def _on_worker(version: str, task: Task, argument: Any, topic: str) -> Any:
    """Run a task; errors name the worker."""
    from distributed import get_worker

    worker = get_worker()
    where = f"worker {worker.address} on {platform.node()}"
    if version != __version__:
        raise LegsError(f"{where} has legs-loss {__version__}, not {version}: install the same version on every worker")
    try:
        return task(argument, lambda message: worker.log_event(topic, message))
    except (LegsError, OSError, MemoryError) as error:
        raise LegsError(f"{where}: {error or 'not enough memory'}") from None
