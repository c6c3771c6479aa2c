"""Eight float32 or int32 at once, as types that compiled functions compute with: for the CPU rasterizers and Adam.

LLVM's own vectoriser gives up on loops that read more than a few rows: it cannot show in time that they do not overlap.
Here the vectors are written down, and LLVM maps them to what the processor has (AVX, two halves of SSE or NEON).

`+ - * /` and comparisons do as IEEE says, each by itself, but for what the caller's `fastmath` allows, whose flags they
get; `multiply_add` may round once. vectors.py has the types, memory.py loads and stores, arithmetic.py works lane by
lane, lanes.py across lanes.
"""

from legs_loss.kernels.simd.arithmetic import (
    above,
    absolute,
    as_floats,
    as_integers,
    at_least,
    equal,
    maximum,
    minimum,
    multiply_add,
    sign,
    splat,
    square_root,
    where,
)
from legs_loss.kernels.simd.lanes import lane, shifted, total, totals
from legs_loss.kernels.simd.memory import load, prefetch, store
from legs_loss.kernels.simd.vectors import LANES

__all__ = [
    "LANES",
    "above",
    "absolute",
    "as_floats",
    "as_integers",
    "at_least",
    "equal",
    "lane",
    "load",
    "maximum",
    "minimum",
    "multiply_add",
    "prefetch",
    "shifted",
    "sign",
    "splat",
    "square_root",
    "store",
    "total",
    "totals",
    "where",
]
