"""Eight float32 at once, as a type that compiled functions compute with.

LLVM's own vectoriser gives up on loops that read more than a few rows: it cannot show in time that they do not overlap.
Here the vectors are written down, and LLVM maps them to what the processor has (AVX, two halves of SSE or NEON).

`+ - * /` and comparisons round as IEEE says, each by itself; `multiply_add` may round once.
"""

from __future__ import annotations

import operator
from typing import Any, Sequence, Tuple

from llvmlite import ir
from numba import extending, njit, types
from numba.core import cgutils
from numba.core.errors import RequireLiteralValue
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

__all__ = [
    "LANES",
    "absolute",
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
]

LANES = 8

_VECTOR = ir.VectorType(ir.FloatType(), LANES)


class _Float8(types.Type):
    def __init__(self) -> None:
        super().__init__(name="float8")


float8 = _Float8()


def _intrinsic(function: Any) -> Any:
    return extending.intrinsic(function)


@register_model(_Float8)
class _Float8Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _operator(symbol: Any, instruction: str) -> None:
    class Template(ConcreteTemplate):
        cases = [signature(float8, float8, float8)]

    infer_global(symbol)(Template)

    @lower_builtin(symbol, float8, float8)
    def lower(context: Any, builder: Any, sig: Any, args: Tuple[Any, Any]) -> Any:
        return getattr(builder, instruction)(*args)


for _symbol, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operator(_symbol, _instruction)


def _is_row(array: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype == types.float32 and array.ndim == 1 and array.layout == "C"


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


@_intrinsic
def load(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Return array[index : index + 8] of a contiguous float32 array of one dimension. Nothing checks the bounds."""
    if not (_is_row(array) and isinstance(index, types.Integer)):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(_address(context, builder, sig.args[0], *args), align=4)

    return float8(array, types.intp), generate


@_intrinsic
def store(typingctx, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index : index + 8]. Nothing checks the bounds."""
    if not (_is_row(array) and isinstance(index, types.Integer) and value == float8):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _address(context, builder, sig.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, float8), generate


@_intrinsic
def prefetch(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Ask for the cache line of array[index] ahead of time. An index beyond the array does no harm."""
    if not (_is_row(array) and isinstance(index, types.Integer)):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        byte, integer = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, integer, integer, integer])
        ask = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        reading, keep, data_cache = integer(0), integer(3), integer(1)
        builder.call(ask, [builder.bitcast(builder.gep(data, [args[1]]), byte), reading, keep, data_cache])
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


@_intrinsic
def splat(typingctx, value):  # type: ignore[no-untyped-def]
    """Return a vector of one value eight times."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0))
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), lanes)

    return float8(types.float32), generate


def _calling(name: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(args))
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return builder.call(function, args)

    return generate


@_intrinsic
def multiply_add(typingctx, a, b, c):  # type: ignore[no-untyped-def]
    """Return a * b + c, rounded once where the processor can."""
    return float8(float8, float8, float8), _calling("fmuladd")


@_intrinsic
def minimum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the smaller value of each lane; of a NaN and a number, the number."""
    return float8(float8, float8), _calling("minnum")


@_intrinsic
def maximum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the larger value of each lane; of a NaN and a number, the number."""
    return float8(float8, float8), _calling("maxnum")


@_intrinsic
def absolute(typingctx, a):  # type: ignore[no-untyped-def]
    """Return |a|."""
    return float8(float8), _calling("fabs")


@_intrinsic
def square_root(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the square root, correctly rounded."""
    return float8(float8), _calling("sqrt")


@_intrinsic
def sign(typingctx, a):  # type: ignore[no-untyped-def]
    """Return -1, 0 or 1 in each lane, as torch.sign does."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        above = builder.uitofp(builder.fcmp_ordered(">", args[0], zero), _VECTOR)
        below = builder.uitofp(builder.fcmp_ordered("<", args[0], zero), _VECTOR)
        return builder.fsub(above, below)

    return float8(float8), generate


@_intrinsic
def shifted(typingctx, a, b, count):  # type: ignore[no-untyped-def]
    """Return array[i + count : i + count + 8] where a and b are its values from i and from i + 4; count is 1, 2 or 3.

    It takes one instruction of the shuffling units, where a load across two cache lines takes two of the loading ones.
    """
    if not isinstance(count, types.IntegerLiteral):
        raise RequireLiteralValue("count")
    count = count.literal_value
    lanes = [half + (k + count if k + count < 4 else LANES + k + count - 4) for half in (0, 4) for k in range(4)]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.shuffle_vector(args[0], args[1], ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes))

    return float8(float8, float8, types.IntegerLiteral(count)), generate


@_intrinsic
def lane(typingctx, a, index):  # type: ignore[no-untyped-def]
    """Return one of the eight values."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.extract_element(args[0], builder.trunc(args[1], ir.IntType(32)))

    return types.float32(float8, types.intp), generate


@njit(inline="always")
def total(a):  # type: ignore[no-untyped-def]
    """Return the sum of the eight values, always added in the same order."""
    return ((lane(a, 0) + lane(a, 1)) + (lane(a, 2) + lane(a, 3))) + (
        (lane(a, 4) + lane(a, 5)) + (lane(a, 6) + lane(a, 7))
    )
