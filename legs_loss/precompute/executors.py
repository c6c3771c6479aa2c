"""Run a task for each argument: in this process, in others of this machine, or on the workers of a dask scheduler.

A task is a function of a module: of an argument and of ``tell``, which sends a message (numbers, strings, lists, dicts)
to the caller. Workers of a scheduler need access to the task's files: the file system is shared.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import platform
import signal
import sys
import uuid
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any, Callable, Dict, Generator, Iterable, Iterator, Optional, Tuple

import torch

from legs_loss._version import __version__
from legs_loss.errors import LegsError, require

Listener = Callable[[Any], None]
Work = Callable[[Any, Listener], Any]
Outcomes = Generator[Tuple[Any, Any], None, None]
_PATIENCE = 30  # seconds for a scheduler to answer, and for its first worker
_PATIENCE_AT_END = 5.0  # seconds; a process that is killed leaves numba's semaphore behind, and Python warns
# The memory of a photograph of up to 16 megapixels in one piece, and kept for the next one: mapping new memory took a
# quarter of the decoding.
_PILLOW = {"PILLOW_BLOCK_SIZE": "64m", "PILLOW_BLOCKS_MAX": "2"}


def outcomes(
    task: Work, arguments: Iterable[Any], listen: Listener, processes: int = 0, scheduler: Optional[str] = None
) -> Outcomes:
    """Yield each argument with the result of its task, or the LegsError that this ended in, in the order they end.

    Args:
        task: what is run.
        arguments: of the tasks.
        listen: gets what all tasks tell, maybe in another thread.
        processes: how many run them at once, each with one thread; 0 runs them here, one after the other.
        scheduler: a dask scheduler's address ("tcp://host:8786"), whose workers run them.

    Raises:
        LegsError: dask is missing, or no scheduler or no worker answers; this user may not enter the current folder.
    """
    if scheduler is not None:
        yield from _on_cluster(task, arguments, scheduler, listen)
    elif processes > 0:
        yield from _in_processes(task, arguments, processes, listen)
    else:
        for argument in arguments:
            yield argument, _outcome(task, argument, listen)


def _outcome(task: Work, argument: Any, tell: Listener) -> Any:
    try:
        return task(argument, tell)
    except LegsError as error:
        return error


def _started(task: Work) -> Tuple[Any, BaseProcess]:
    """Start a process that runs tasks, one at a time; return this side's end of its pipe, and the process.

    One that dies costs one task, and when this process dies, it finds its pipe closed and ends.
    """
    if not os.access(os.curdir, os.X_OK):  # the child is started in it, by its name
        raise LegsError("the current folder is another user's, and processes cannot be started in it: leave it")
    context = multiprocessing.get_context("spawn")  # forked, it would inherit locks and threads
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, task), daemon=True)
    with keep_ctrl_c_from_children():
        process.start()
    theirs.close()
    return ours, process


def _end(connection: Any, process: BaseProcess, patience: float = 0.0) -> None:
    """Close the pipe, which ends the process when it is idle; after some seconds kill it."""
    connection.close()
    process.join(patience)
    process.terminate()
    process.join()


@contextmanager
def keep_ctrl_c_from_children() -> Iterator[None]:
    """Delay Ctrl-C while processes are started: they never get it, this process gets it right afterwards.

    On Windows, where signals cannot be delayed, it is ignored meanwhile.
    """
    if hasattr(signal, "pthread_sigmask"):
        # Multiprocessing's resource tracker: started by the first process, it would let signals through again.
        tracker = "resource_tracker" if sys.version_info >= (3, 8) else "semaphore_tracker"
        import_module(f"multiprocessing.{tracker}").ensure_running()
        held = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # inherited, for good
        restore: Callable[[], Any] = partial(signal.pthread_sigmask, signal.SIG_SETMASK, held)
    else:
        restore = partial(signal.signal, signal.SIGINT, signal.signal(signal.SIGINT, signal.SIG_IGN))
    try:
        yield
    finally:
        restore()


def _in_processes(task: Work, arguments: Iterable[Any], processes: int, listen: Listener) -> Outcomes:
    waiting = list(arguments)[::-1]
    crew: Dict[Any, Tuple[BaseProcess, Any]] = {}  # by this side's end of their pipes

    def give(connection: Any, process: BaseProcess) -> None:
        crew[connection] = process, waiting.pop()
        with suppress(OSError):  # it died; its pipe will say so
            connection.send(crew[connection][1])

    try:
        for _ in range(min(processes, len(waiting))):
            give(*_started(task))
        while crew:
            ready: Iterable[Any] = wait(list(crew))
            for connection in ready:
                is_alive = True
                try:
                    ended, message = connection.recv()
                except (EOFError, OSError):
                    is_alive, ended, message = False, True, LegsError("its process was killed (out of memory?)")
                if not ended:
                    listen(message)
                    continue
                process, argument = crew.pop(connection)
                if not (is_alive and waiting):
                    _end(connection, process, _PATIENCE_AT_END)
                if waiting:
                    give(*((connection, process) if is_alive else _started(task)))
                yield argument, message
    finally:
        for connection, (process, _) in crew.items():
            _end(connection, process)


def _work(connection: Any, task: Work) -> None:
    """Run tasks until the parent has ended."""
    if not any(name in os.environ for name in _PILLOW):
        os.environ.update(_PILLOW)  # before Pillow is imported, which reads them
    torch.set_num_threads(1)
    with suppress(EOFError, OSError):
        while True:
            argument = connection.recv()
            try:
                result = _outcome(task, argument, lambda message: connection.send((False, message)))
            except OSError as error:  # a full disk is no fault of the code either
                result = LegsError(str(error))
            connection.send((True, result))


def _on_cluster(task: Work, arguments: Iterable[Any], scheduler: str, listen: Listener) -> Outcomes:
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
        submit = partial(client.submit, _on_worker, __version__, task, topic, pure=False)
        futures = {submit(argument): argument for argument in arguments}
        for future in as_completed(futures, loop=client.loop):
            yield futures[future], _outcome_there(future)


def _outcome_there(future: Any) -> Any:
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


def _on_worker(version: str, task: Work, topic: str, argument: Any) -> Any:
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
