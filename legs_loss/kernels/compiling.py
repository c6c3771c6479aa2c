"""`compiled`, `part` and `inlined`: numba's njit as the package uses it; a multiply-add; the threads of a call."""

from __future__ import annotations

import os
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Callable, List, Optional

import numba
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils, extending

# No NaN or infinity arises from checked input. Sums keep their order, and a * b + c is rounded twice unless the code
# says otherwise: if the compiler may choose, the process that compiles and a later one that loads the cached code can
# differ in the last bit.
FAST = {"nnan", "ninf", "nsz"}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function on its first call, and keep the machine code on disk where a cache can be written."""
    options = {"fastmath": FAST, "error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True, **options}

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package's folder nor the user's can be written
            return numba.njit(**options)(function)

    return decorate


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that only compiled functions call: Python must not, since it gets no entry for Python.

    The machine code of all that a function calls is made once more with it, so few of them lie one within the other.
    """
    return compiled(no_cpython_wrapper=True, **options)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into its callers, with their settings."""
    return numba.njit(inline="always")(function)


def _multiply_add(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """Return a * b + c of float32, rounded once where the processor can."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.FloatType(), [ir.FloatType()] * 3)
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.f32"), args)

    return types.float32(types.float32, types.float32, types.float32), generate


multiply_add: Any = extending.intrinsic(_multiply_add)


def _claimed(typingctx: Any, counter: Any) -> Any:
    """Return the number in int64 [1] and add one to it, in one step for all threads."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), generate


claimed: Any = extending.intrinsic(_claimed)

_MOST: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # a user's, or the processor's cores


class _Helpers:
    """The threads beside the one that calls, begun when they are first needed, and anew in a forked process."""

    def __init__(self) -> None:
        self.pool: Optional[ThreadPoolExecutor] = None

    def forget(self) -> None:
        self.pool = None

    def begin(self, count: int, function: Callable[..., Any], *given: Any) -> List[Future[Any]]:
        """Have up to so many of them call a function."""
        begun: List[Future[Any]] = []
        with suppress(RuntimeError):  # the interpreter is shutting down, or no thread can be started
            while len(begun) < min(count, _MOST - 1):
                self.pool = self.pool or ThreadPoolExecutor(_MOST - 1, "legs-loss")
                begun.append(self.pool.submit(function, *given))
        return begun


_HELPERS = _Helpers()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_HELPERS.forget)


def in_threads(function: Callable[..., Any], tasks: int, *given: Any) -> None:
    """Call a compiled function on as many threads as torch would use.

    It is given a counter, the number of tasks, and the rest. Each thread claims a task after the other from the
    counter, so one that comes late, or never, leaves its share to the others. (numba's own parallel loops compile each
    function that they call two times more, and one of their three kinds ends the process when two threads use it.)
    """
    counter = np.zeros(1, np.int64)
    helpers = _HELPERS.begin(min(torch.get_num_threads(), tasks) - 1, function, counter, tasks, *given)
    function(counter, tasks, *given)
    for helper in helpers:
        if not helper.cancel():
            helper.result()
