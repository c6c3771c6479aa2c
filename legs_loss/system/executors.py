"""Run tasks in this process, or on the workers of a dask scheduler. Both are concurrent.futures' Executor.

A task is a function of a module with its arguments. A task that reports progress takes ``tell``, which sends a message
(numbers, strings, lists, dicts) to the caller. Workers need access to the task's files: the file system is shared.
"""

from __future__ import annotations

import asyncio
import platform
import uuid
from concurrent.futures import Executor, Future, as_completed
from contextlib import contextmanager
from typing import Any, Callable, Dict, Iterable, Iterator, NamedTuple, Optional, Tuple

from legs_loss._version import __version__
from legs_loss.errors import LegsError

__all__ = ["Listener", "executor", "in_the_order_they_end"]

Listener = Callable[[Any], None]
_PATIENCE = 30  # seconds for a scheduler to answer, and for its first worker


@contextmanager
def executor(scheduler: Optional[str], listen: Listener) -> Iterator[Tuple[Executor, Listener]]:
    """Yield an executor and the ``tell`` of its tasks: this process one after the other, or a dask scheduler's workers.

    Args:
        scheduler: a dask scheduler's address ("tcp://host:8786"); None for this process.
        listen: gets what all tasks tell, maybe in another thread.

    Raises:
        LegsError: dask is missing, or no scheduler or no worker answers.
    """
    if scheduler is None:
        yield _Here(), listen
        return
    try:
        from distributed import Client
    except ImportError:
        raise LegsError("--scheduler needs dask: pip install 'legs-loss[cluster]'") from None
    try:
        client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise LegsError(f"no dask scheduler answers at {scheduler}: {error}") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except (TimeoutError, asyncio.TimeoutError):
            raise LegsError(f"the scheduler {scheduler} has no workers: start some with `dask worker`") from None
        topic = f"legs-{uuid.uuid4().hex}"
        client.subscribe_topic(topic, lambda event: listen(event[1]))
        yield _Cluster(client), _Topic(topic).tell


def in_the_order_they_end(
    runs: Executor, function: Callable[..., Any], arguments: Iterable[Any], *more: Any
) -> Iterator[Tuple[Any, Any]]:
    """Run ``function(argument, *more)`` for each argument; yield each with its result, or the LegsError it ended in."""
    waiting: Dict[Any, Any] = {}
    for argument in arguments:
        future = runs.submit(function, argument, *more)
        if future.done():  # in this process, one after the other
            yield argument, _outcome(future)
        else:
            waiting[future] = argument
    for future in as_completed(waiting):
        yield waiting[future], _outcome(future)


def _outcome(future: Future[Any]) -> Any:
    try:
        return future.result()
    except LegsError as error:
        return error
    except Exception as error:
        if type(error).__module__.split(".")[0] != "distributed" and not isinstance(error, ModuleNotFoundError):
            raise
        if type(error).__name__ == "KilledWorker":
            last = getattr(error, "last_worker", None)
            return LegsError(
                f"the workers that took it died, the last one being {getattr(last, 'address', 'unknown')} (out of "
                "memory?)"
            )
        return LegsError(f"a worker could not run it: {error}")


class _Here(Executor):
    """Run a task when it is submitted, in this process and thread, so that Ctrl-C reaches it."""

    def submit(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Future[Any]:  # type: ignore[override]
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class _Cluster(Executor):
    """Hand tasks to dask's own executor. A task whose worker dies is given to another one."""

    def __init__(self, client: Any) -> None:
        self._executor = client.get_executor(pure=False)

    def submit(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Future[Any]:  # type: ignore[override]
        return self._executor.submit(_on_worker, __version__, function, arguments, named)


class _Topic(NamedTuple):
    """The topic of a worker's messages; the scheduler passes them on."""

    name: str

    def tell(self, message: Any) -> None:
        from distributed import get_worker

        get_worker().log_event(self.name, message)


def _on_worker(version: str, function: Callable[..., Any], arguments: Tuple[Any, ...], named: Dict[str, Any]) -> Any:
    """Run a task; errors name the worker."""
    from distributed import get_worker

    worker = get_worker()
    where = f"worker {worker.address} on {platform.node()}"
    if version != __version__:
        raise LegsError(f"{where} has legs-loss {__version__}, not {version}: install the same version on every worker")
    try:
        return function(*arguments, **named)
    except (LegsError, OSError, MemoryError) as error:
        raise LegsError(f"{where}: {error or 'not enough memory'}") from None
