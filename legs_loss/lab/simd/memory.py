"""Vectors to and from memory."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from legs_loss.lab.simd.vectors import KINDS, intrinsic


def _is_row(array: Any, dtype: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype == dtype and array.ndim == 1 and array.layout == "C"


def _vector_of(array: Any) -> Any:
    """Return the kind of vector that a row holds, or None where it is no row of either."""
    return next((kind for dtype, kind in KINDS.items() if _is_row(array, dtype)), None)


def _address(context: Any, builder: Any, kind: Any, lanes: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), lanes.as_pointer())


@intrinsic
def load(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Return array[index : index + 8] of a contiguous array of one dimension. Nothing checks the bounds."""
    kind = _vector_of(array)
    if kind is None or not isinstance(index, types.Integer):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(_address(context, builder, sig.args[0], kind.lanes, *args), align=4)

    return kind(array, types.intp), generate


@intrinsic
def store(typingctx, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index : index + 8]. Nothing checks the bounds."""
    kind = _vector_of(array)
    if kind is None or not isinstance(index, types.Integer) or value != kind:
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _address(context, builder, sig.args[0], kind.lanes, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, kind), generate


@intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Ask for array[index] of a contiguous array ahead of time: for the cache lines in which it begins and ends.

    What is read in no order, or from rows far apart, costs a wait each; asked for in time, it costs nothing. An index
    beyond the array does no harm: the processor ignores an address that it cannot read.
    """
    if not (isinstance(array, types.Array) and array.layout == "C" and isinstance(index, types.Integer)):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        array_type, size = sig.args
        values = context.make_array(array_type)(context, builder, args[0])
        number, byte, integer = context.get_value_type(size), ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, integer, integer, integer])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        reading, keep, data_cache = integer(0), integer(3), integer(1)
        element = number(context.get_abi_sizeof(values.data.type.pointee))
        row = element if array_type.ndim == 1 else builder.extract_value(values.strides, 0)
        start = builder.add(builder.ptrtoint(values.data, number), builder.mul(row, args[1]))
        ends = [start] if array_type.ndim == 1 else [start, builder.add(start, builder.sub(row, element))]
        for address in ends:
            builder.call(ask, [builder.inttoptr(address, byte), reading, keep, data_cache])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate
