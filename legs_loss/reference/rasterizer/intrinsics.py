"""An instruction that Python has no words for: asking for memory ahead of time."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


@intrinsic
def prefetch(context: Any, array: Any, row: Any) -> Any:
    """Ask for the beginning and the end of a row of a contiguous array [N, ...], which may lie anywhere in memory.

    Rows that are read in no order cost a wait each; asked for a few rows ahead, they cost nothing. The row's number is
    not checked: the processor ignores an address that it cannot read.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind, _ = signature.args
        values = context.make_array(kind)(context, builder, arguments[0])
        stride = builder.extract_value(values.strides, 0)
        byte, integer = ir.IntType(8), ir.IntType(32)
        start = builder.ptrtoint(values.data, stride.type)
        start = builder.add(start, builder.mul(stride, builder.sext(arguments[1], stride.type)))
        pointer = byte.as_pointer()
        ask = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [pointer, integer, integer, integer]), "llvm.prefetch.p0i8"
        )
        reading, keep, data = integer(0), integer(3), integer(1)
        for address in (start, builder.add(start, builder.sub(stride, stride.type(1)))):
            builder.call(ask, [builder.inttoptr(address, pointer), reading, keep, data])
        return context.get_dummy_value()

    return types.void(array, types.int32), generate
