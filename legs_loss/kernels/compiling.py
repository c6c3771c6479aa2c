"""`compiled`, `part` and `inlined`: numba's njit as the package uses it, and what is said while it compiles.

And a multiply-add, and the threads of a call.
"""

from __future__ import annotations

import gc
import operator
import os
import sys
import threading
import time
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any, Callable, Iterable, Iterator, List, Optional, Sequence

import numba
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils, event, extending
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.typing import arraydecl
from numba.core.typing.templates import infer_global
from tqdm import tqdm

from legs_loss.kernels.code_cache import keep
from legs_loss.system.terminal import is_first_process, say

# No NaN or infinity arises from checked input. Sums keep their order, and a * b + c is rounded twice unless the code
# says otherwise: if the compiler may choose, the process that compiles and a later one that loads the cached code can
# differ in the last bit.
FAST = {"nnan", "ninf", "nsz"}
_OPTIONS = {"fastmath": FAST, "error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True, "_nrt": False}


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function on its first call, and keep the machine code on disk where a cache can be written.

    References to arrays are not counted in it, since that locks memory twice a slice; a function that makes an array
    has to be given `_nrt=True`, as numba calls it, and compiles longer: better it is given what `in_threads` makes.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**{**_OPTIONS, **options})(function)
        keep(function, dispatcher)
        return dispatcher

    return decorate


def part(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that only compiled functions call: Python must not, since it gets no entry for Python.

    It is optimised, becomes machine code and is kept on disk with those that call it, and not by itself.
    """
    return numba.njit(**{**_OPTIONS, "no_cpython_wrapper": True, "pipeline_class": _PartCompiler, **options})


class _Part(JITCodeLibrary):
    """The code of a part, as it was lowered."""

    codegen: Any = SimpleNamespace(set_env=lambda name, env: None)  # only machine code has an address to write it to

    def _optimize_final_module(self) -> None:
        """Leave that to those that call it."""

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _PartCompiler(Compiler):
    def compile_extra(self, function: Callable[..., Any]) -> Any:
        self.state.library = _Part(self.state.targetctx.codegen(), function.__qualname__)
        return super().compile_extra(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into its callers, with their settings."""
    return numba.njit(inline="always")(function)


class _NoCollector(event.Listener):
    """Keep Python's garbage collector off while numba compiles: it walked all that torch imported, again and again."""

    depth, was_on = 0, False

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.was_on = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0 and self.was_on:
            gc.enable()


event.register("numba:compile", _NoCollector())

# numba types an array's element last, after seven overloads for strings and lists, with literals and without; what is
# of this processor, not of any, it tries first.
for _symbol, _template in ((operator.getitem, arraydecl.GetItemBuffer), (operator.setitem, arraydecl.SetItemBuffer)):
    infer_global(_symbol)(type("First" + _template.__name__, (_template,), {"metadata": {"target": "cpu"}}))


@contextmanager
def said(command: str, expected: str, functions: Sequence[Any] = ()) -> Iterator[None]:
    """Say on stderr that the block compiles, and at its end how long that took; nothing where all is in the cache.

    Args:
        command: who says it.
        expected: how long it takes, such as "20 to 60 s".
        functions: the compiled functions that the block calls, for a bar on a terminal.
    """
    progress = _Compiling(command, expected, functions)
    try:
        with event.install_listener("numba:compile", progress):
            yield
    finally:
        progress.end()


class _Compiling(event.Listener):
    def __init__(self, command: str, expected: str, functions: Sequence[Any]) -> None:
        self.command, self.expected, self.functions = command, expected, functions
        self.depth, self.seconds, self.count = 0, 0.0, 0
        self.bar: Optional[Any] = None

    def on_start(self, event: Any) -> None:
        if self.bar is None:
            self._say(f"compiling for this processor, once a machine: {self.expected}")
            self.bar = tqdm(total=len(self.functions) or None, desc="compiling", unit="function", disable=None)
        if self.depth == 0:  # a function is compiled within those that call it
            self.begun = time.perf_counter()
            self.bar.set_postfix_str(event.data["dispatcher"].py_func.__name__.strip("_"))
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0 and self.bar is not None:
            self.seconds += time.perf_counter() - self.begun
            self.count += 1
            done = sum(bool(function.overloads) for function in self.functions)
            self.bar.update((done or self.count) - self.bar.n)

    def end(self) -> None:
        if self.bar is not None:
            self.bar.close()
            self._say(f"compiled in {self.seconds:.0f} s, and kept for later")

    def _say(self, text: str) -> None:
        if is_first_process():
            say(f"{self.command}: {text}", sys.stderr)


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

_Own = Callable[[], Iterable[Any]]  # makes the arguments that no other thread is given
_MOST: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]  # a user's, or the processor's cores
_tasks: SimpleQueue[Any] = SimpleQueue()
_helpers: List[threading.Thread] = []  # the threads beside the one that calls, begun when they are first needed


def _help(tasks: SimpleQueue[Any]) -> None:
    while True:
        _take(*tasks.get())  # a call, which keeps nothing of the task


def _take(calls: List[Any], ended: SimpleQueue[Any]) -> None:
    try:
        function, own, given = calls.pop()
    except IndexError:  # who called has not waited
        return
    error = None
    try:
        function(*own(), *given)
    except BaseException as raised:
        error = raised
    # Who lets a tensor go last frees it; a thread that does so while the interpreter shuts down aborts the process.
    del function, own, given
    ended.put(error)


def _begin(count: int) -> None:
    with suppress(RuntimeError):  # the interpreter is shutting down, or no thread can be started
        while len(_helpers) < count:
            helper = threading.Thread(target=_help, args=(_tasks,), name="legs-loss", daemon=True)
            helper.start()
            _helpers.append(helper)


def _begin_anew() -> None:
    global _tasks
    _tasks = SimpleQueue()
    _helpers.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)  # a forked process has no threads


def aligned(count: int, dtype: Any = np.float32) -> np.ndarray:
    """Return zeros that begin where a cache line does. (torch's do, too, but see `_take`.)"""
    memory = np.zeros(count + 16, dtype)
    return memory[-(memory.__array_interface__["data"][0] // memory.itemsize) % (64 // memory.itemsize) :][:count]


def in_threads(function: Callable[..., Any], tasks: int, *given: Any, own: _Own = tuple) -> None:
    """Call a compiled function on as many threads as torch would use.

    It is given what `own` makes for each thread, a counter, the number of tasks, and the rest. Each thread claims a
    task after the other from the counter, so one that comes late, or never, leaves its share to the others. (numba's
    own parallel loops compile each function that they call two times more, and one of their three kinds ends the
    process when two threads use it.)
    """
    given = (np.zeros(1, np.int64), tasks, *given)
    count = min(torch.get_num_threads(), tasks, _MOST) - 1
    if count > len(_helpers):
        _begin(count)
    # Queues and lists are used as they are: with futures each step would take twenty calls of Python more.
    calls = [(function, own, given)] * min(count, len(_helpers))
    begun, ended = len(calls), SimpleQueue()  # type: ignore[var-annotated]
    for _ in range(begun):
        _tasks.put((calls, ended))
    function(*own(), *given)
    while calls:  # who has not begun finds no task left
        with suppress(IndexError):
            calls.pop()
            begun -= 1
    for _ in range(begun):
        error = ended.get()
        if error is not None:
            raise error
