"""Arithmetic, comparisons and the bits of each lane."""

from __future__ import annotations

from typing import Any, Sequence

from llvmlite import ir
from numba import types
from numba.core import cgutils

from legs_loss.lab.simd.vectors import FLOATS, INTEGERS, KINDS, LANES, float8, integer8, intrinsic, mask8


@intrinsic
def splat(typingctx, value):  # type: ignore[no-untyped-def]
    """Return a vector of one value eight times: an int32, or a float."""
    dtype = types.int32 if value == types.int32 else types.float32
    kind = KINDS[dtype]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        nothing = ir.Constant(kind.lanes, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, nothing, ir.Constant(INTEGERS, [0] * LANES))

    return kind(dtype), generate


def _calling(name: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        kind = ir.FunctionType(FLOATS, [FLOATS] * len(args))
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return builder.call(function, args)

    return generate


@intrinsic
def multiply_add(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """Return a * b + c, rounded once where the processor can."""
    return float8(float8, float8, float8), _calling("fmuladd")


def _choosing(comparison: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        compare = builder.fcmp_ordered if sig.return_type == float8 else builder.icmp_signed
        return builder.select(compare(comparison, *args), *args)

    return generate


@intrinsic
def minimum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the smaller value of each lane; b's, where either is a NaN."""
    return a(a, a), _choosing("<")


@intrinsic
def maximum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the larger value of each lane; b's, where either is a NaN."""
    return a(a, a), _choosing(">")


def _comparing(comparison: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        return builder.fcmp_ordered(comparison, *args)

    return generate


@intrinsic
def at_least(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a >= b."""
    return mask8(float8, float8), _comparing(">=")


@intrinsic
def above(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a > b."""
    return mask8(float8, float8), _comparing(">")


@intrinsic
def equal(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a == b."""
    return mask8(float8, float8), _comparing("==")


@intrinsic
def where(typingctx, mask, a, b):  # type: ignore[no-untyped-def]
    """Return a's value in the lanes of the mask, and b's in the others."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return float8(mask8, float8, float8), generate


def _reading(kind: Any) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        return builder.bitcast(args[0], kind)

    return generate


@intrinsic
def as_integers(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the bits of float32 as int32."""
    return integer8(float8), _reading(INTEGERS)


@intrinsic
def as_floats(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the float32 that have the bits of int32."""
    return float8(integer8), _reading(FLOATS)


@intrinsic
def absolute(typingctx, a):  # type: ignore[no-untyped-def]
    """Return |a|."""
    return float8(float8), _calling("fabs")


@intrinsic
def square_root(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the square root, correctly rounded."""
    return float8(float8), _calling("sqrt")
