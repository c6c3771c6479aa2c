"""`compiled` and `inlined`: numba's njit as the package uses it; a multiply-add; the threads of a parallel call."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import Any, Callable, Iterator

import numba
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
    options = {"fastmath": FAST, "error_model": "numpy", **options}

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError:  # neither the package's folder nor the user's can be written
            return numba.njit(**options)(function)

    return decorate


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

# Of numba's three ways to run threads, one ends the process when two of Python's threads use it at a time.
ONE_AT_A_TIME = threading.Lock()


@contextmanager
def threads_of_torch() -> Iterator[None]:
    """Run parallel loops on as many threads as torch would, one call at a time."""
    with ONE_AT_A_TIME:
        before = numba.get_num_threads()
        numba.set_num_threads(min(torch.get_num_threads(), before))
        try:
            yield
        finally:
            numba.set_num_threads(before)
