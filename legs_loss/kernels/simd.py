"""Eight float32 or int32 at once, as types that compiled functions compute with.

LLVM's own vectoriser gives up on loops that read more than a few rows: it cannot show in time that they do not overlap.
Here the vectors are written down, and LLVM maps them to what the processor has (AVX, two halves of SSE or NEON).

`+ - * /` and comparisons do as IEEE says, each by itself, but for what the caller's `fastmath` allows, whose flags they
get; `multiply_add` may round once.
"""

from __future__ import annotations

import operator
from typing import Any, Sequence, Tuple

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.errors import RequireLiteralValue
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

from legs_loss.kernels.compiling import inlined

__all__ = [
    "LANES",
    "above",
    "absolute",
    "as_floats",
    "as_integers",
    "at_least",
    "equal",
    "halves_added",
    "lane",
    "load",
    "load_bytes",
    "maximum",
    "minimum",
    "multiply_add",
    "prefetch",
    "shifted",
    "sign",
    "splat",
    "square_root",
    "store",
    "store_bytes",
    "total",
    "totals",
    "where",
    "without_fourths",
]

LANES = 8

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INTEGERS = ir.VectorType(ir.IntType(32), LANES)
_BYTES = ir.VectorType(ir.IntType(8), LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _Vector(types.Type):
    def __init__(self, name: str, lanes: Any) -> None:
        super().__init__(name=name)
        self.lanes = lanes


float8: _Vector = _Vector("float8", _VECTOR)
integer8: _Vector = _Vector("integer8", _INTEGERS)
mask8: _Vector = _Vector("mask8", _MASK)
_KINDS = {types.float32: float8, types.int32: integer8}


def _intrinsic(function: Any) -> Any:
    return extending.intrinsic(function)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.lanes)


def _operator(symbol: Any, kind: Any, instruction: str) -> None:
    class Template(ConcreteTemplate):
        cases = [signature(kind, kind, kind)]

    infer_global(symbol)(Template)

    @lower_builtin(symbol, kind, kind)
    def lower(context: Any, builder: Any, sig: Any, args: Tuple[Any, Any]) -> Any:
        return getattr(builder, instruction)(*args)


for _symbol, _kind, _instruction in (
    (operator.add, float8, "fadd"),
    (operator.sub, float8, "fsub"),
    (operator.mul, float8, "fmul"),
    (operator.truediv, float8, "fdiv"),
    (operator.add, integer8, "add"),
    (operator.mul, integer8, "mul"),
    (operator.lshift, integer8, "shl"),
    (operator.rshift, integer8, "ashr"),
    (operator.and_, mask8, "and_"),
):
    _operator(_symbol, _kind, _instruction)


class _Negative(ConcreteTemplate):
    cases = [signature(float8, float8)]


infer_global(operator.neg)(_Negative)


@lower_builtin(operator.neg, float8)
def _negative(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
    return builder.fneg(*args)


def _is_row(array: Any, dtype: Any) -> bool:
    return isinstance(array, types.Array) and array.dtype == dtype and array.ndim == 1 and array.layout == "C"


def _vector_of(array: Any) -> Any:
    """Return the kind of vector that a row holds, or None where it is no row of either."""
    return next((kind for dtype, kind in _KINDS.items() if _is_row(array, dtype)), None)


def _address(context: Any, builder: Any, kind: Any, lanes: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), lanes.as_pointer())


@_intrinsic
def load(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Return array[index : index + 8] of a contiguous array of one dimension. Nothing checks the bounds."""
    kind = _vector_of(array)
    if kind is None or not isinstance(index, types.Integer):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.load(_address(context, builder, sig.args[0], kind.lanes, *args), align=4)

    return kind(array, types.intp), generate


@_intrinsic
def load_bytes(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Return array[index : index + 8] of a contiguous uint8 array as eight int32. Nothing checks the bounds."""
    if not (_is_row(array, types.uint8) and isinstance(index, types.Integer)):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        values = builder.load(_address(context, builder, sig.args[0], _BYTES, *args), align=1)
        return builder.zext(values, _INTEGERS)

    return integer8(array, types.intp), generate


@_intrinsic
def store(typingctx, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index : index + 8]. Nothing checks the bounds."""
    kind = _vector_of(array)
    if kind is None or not isinstance(index, types.Integer) or value != kind:
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        builder.store(args[2], _address(context, builder, sig.args[0], kind.lanes, *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, kind), generate


@_intrinsic
def store_bytes(typingctx, array, index, value):  # type: ignore[no-untyped-def]
    """Set array[index : index + 8] of a contiguous uint8 array to the low bytes of int32. Nothing checks the bounds."""
    if not (_is_row(array, types.uint8) and isinstance(index, types.Integer) and value == integer8):
        return None

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        bytes_ = builder.trunc(args[2], _BYTES)
        builder.store(bytes_, _address(context, builder, sig.args[0], _BYTES, *args[:2]), align=1)
        return context.get_dummy_value()

    return types.void(array, types.intp, integer8), generate


@_intrinsic
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


@_intrinsic
def splat(typingctx, value):  # type: ignore[no-untyped-def]
    """Return a vector of one value eight times: an int32, or a float."""
    dtype = types.int32 if value == types.int32 else types.float32
    kind = _KINDS[dtype]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        nothing = ir.Constant(kind.lanes, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(first, nothing, ir.Constant(_INTEGERS, [0] * LANES))

    return kind(dtype), generate


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


def _choosing(comparison: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        compare = builder.fcmp_ordered if sig.return_type == float8 else builder.icmp_signed
        return builder.select(compare(comparison, *args), *args)

    return generate


@_intrinsic
def minimum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the smaller value of each lane; b's, where either is a NaN."""
    return a(a, a), _choosing("<")


@_intrinsic
def maximum(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return the larger value of each lane; b's, where either is a NaN."""
    return a(a, a), _choosing(">")


def _comparing(comparison: str) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        return builder.fcmp_ordered(comparison, *args)

    return generate


@_intrinsic
def at_least(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a >= b."""
    return mask8(float8, float8), _comparing(">=")


@_intrinsic
def above(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a > b."""
    return mask8(float8, float8), _comparing(">")


@_intrinsic
def equal(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return in which lanes a == b."""
    return mask8(float8, float8), _comparing("==")


@_intrinsic
def where(typingctx, mask, a, b):  # type: ignore[no-untyped-def]
    """Return a's value in the lanes of the mask, and b's in the others."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(*args)

    return float8(mask8, float8, float8), generate


def _reading(kind: Any) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
        return builder.bitcast(args[0], kind)

    return generate


@_intrinsic
def as_integers(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the bits of float32 as int32."""
    return integer8(float8), _reading(_INTEGERS)


@_intrinsic
def as_floats(typingctx, a):  # type: ignore[no-untyped-def]
    """Return the float32 that have the bits of int32."""
    return float8(integer8), _reading(_VECTOR)


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
        return builder.shuffle_vector(args[0], args[1], ir.Constant(_INTEGERS, lanes))

    return float8(float8, float8, types.IntegerLiteral(count)), generate


@_intrinsic
def halves_added(typingctx, a, b):  # type: ignore[no-untyped-def]
    """Return four values, a's lower half plus its upper, then b's, of two integer vectors."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        lower, upper = ([half + k for half in (start, LANES + start) for k in range(4)] for start in (0, 4))
        return builder.add(*(builder.shuffle_vector(*args, ir.Constant(_INTEGERS, half)) for half in (lower, upper)))

    return integer8(integer8, integer8), generate


@_intrinsic
def without_fourths(typingctx, a):  # type: ignore[no-untyped-def]
    """Return of two times four values the first three each, side by side, and two more of no meaning."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        nothing = ir.Constant(_INTEGERS, ir.Undefined)
        return builder.shuffle_vector(args[0], nothing, ir.Constant(_INTEGERS, [0, 1, 2, 4, 5, 6, 7, 7]))

    return integer8(integer8), generate


@_intrinsic
def _pairs_added(typingctx, a, b, distance):  # type: ignore[no-untyped-def]
    """Return sums of two lanes of a, `distance` apart, and of two of b, in turn for every `distance` lanes."""
    if not isinstance(distance, types.IntegerLiteral):
        raise RequireLiteralValue("distance")
    distance = distance.literal_value
    firsts = [k if k % (2 * distance) < distance else LANES + k - distance for k in range(LANES)]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        both = args[:2]
        first = builder.shuffle_vector(*both, ir.Constant(_INTEGERS, firsts))
        second = builder.shuffle_vector(*both, ir.Constant(_INTEGERS, [k + distance for k in firsts]))
        return builder.fadd(first, second)

    return float8(float8, float8, types.IntegerLiteral(distance)), generate


@inlined
def totals(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Return the sums of eight vectors, each always added in the same order."""
    ab, cd, ef, gh = _pairs_added(a, b, 1), _pairs_added(c, d, 1), _pairs_added(e, f, 1), _pairs_added(g, h, 1)
    return _pairs_added(_pairs_added(ab, cd, 2), _pairs_added(ef, gh, 2), 4)


@_intrinsic
def lane(typingctx, a, index):  # type: ignore[no-untyped-def]
    """Return one of the eight values."""

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.extract_element(args[0], builder.trunc(args[1], ir.IntType(32)))

    return types.float32(float8, types.intp), generate


@inlined
def total(a):  # type: ignore[no-untyped-def]
    """Return the sum of the eight values, always added in the same order."""
    pairs = _pairs_added(a, a, 1)
    fours = _pairs_added(pairs, pairs, 2)
    return lane(_pairs_added(fours, fours, 4), 0)
