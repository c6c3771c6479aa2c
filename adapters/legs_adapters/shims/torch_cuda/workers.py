"""Run pools of processes as pools of threads: a new process would not be redirected."""

from __future__ import annotations

import concurrent.futures
import inspect
import multiprocessing.context
import multiprocessing.pool
from typing import Any, Optional, Tuple

import torch.multiprocessing
import torch.utils.data

from legs_adapters.shims.torch_cuda.redirection import Redirection

__all__ = ["redirect"]


def redirect(redirection: Redirection) -> None:
    """Redirect pools of processes, and loaders whose workers are not forked."""

    class Executor(concurrent.futures.ThreadPoolExecutor):
        """A pool of threads with the arguments of a process pool."""

        def __init__(
            self,
            max_workers: Optional[int] = None,
            mp_context: Any = None,
            initializer: Any = None,
            initargs: Tuple[Any, ...] = (),
            **_: Any,
        ) -> None:
            super().__init__(max_workers, initializer=initializer, initargs=initargs)

    def pool(
        processes: Optional[int] = None, initializer: Any = None, initargs: Any = (), *_: Any, **__: Any
    ) -> multiprocessing.pool.ThreadPool:
        return multiprocessing.pool.ThreadPool(processes, initializer, initargs)

    redirection.replace(concurrent.futures, "ProcessPoolExecutor", Executor)
    redirection.replace(concurrent.futures.process, "ProcessPoolExecutor", Executor)
    redirection.wrap(multiprocessing, "Pool", lambda old: pool)
    redirection.wrap(
        multiprocessing.context.BaseContext,
        "Pool",
        lambda old: lambda self, *args, **kwargs: pool(*args, **kwargs),
    )
    redirection.wrap(torch.multiprocessing, "Pool", lambda old: pool)

    def loader(old: Any) -> Any:
        def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
            bound = inspect.signature(old).bind(self, *args, **kwargs)
            bound.arguments["pin_memory"] = False
            if bound.arguments.get("num_workers") and torch.multiprocessing.get_start_method() != "fork":
                bound.arguments["num_workers"] = 0
            old(*bound.args, **bound.kwargs)

        return __init__

    redirection.wrap(torch.utils.data.DataLoader, "__init__", loader)
