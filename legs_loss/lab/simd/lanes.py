"""Work across lanes: single values, shuffles and sums."""

from __future__ import annotations

from llvmlite import ir
from numba import types
from numba.core.errors import RequireLiteralValue

from legs_loss.kernels.compiling import inlined
from legs_loss.lab.simd.vectors import INTEGERS, LANES, float8, intrinsic


@intrinsic
def _exchanged(typingctx, a, b, distance):  # type: ignore[no-untyped-def]
    """Return two vectors, a and b mixed: in turn for every `distance` lanes, those of a and of b; and what is left."""
    if not isinstance(distance, types.IntegerLiteral):
        raise RequireLiteralValue("distance")
    distance = distance.literal_value
    firsts = [k if k % (2 * distance) < distance else LANES + k - distance for k in range(LANES)]

    def generate(context, builder, sig, args):  # type: ignore[no-untyped-def]
        both = args[:2]
        first = builder.shuffle_vector(*both, ir.Constant(INTEGERS, firsts))
        second = builder.shuffle_vector(*both, ir.Constant(INTEGERS, [k + distance for k in firsts]))
        return context.make_tuple(builder, sig.return_type, [first, second])

    return types.UniTuple(float8, 2)(float8, float8, types.IntegerLiteral(distance)), generate


@inlined
def _pairs_added(a, b, distance):  # type: ignore[no-untyped-def]
    """Return sums of two lanes of a, `distance` apart, and of two of b, in turn for every `distance` lanes."""
    first, second = _exchanged(a, b, distance)
    return first + second


@inlined
def transposed(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Return the columns of eight vectors, the first lanes of all first."""
    (a, b), (c, d), (e, f), (g, h) = _exchanged(a, b, 1), _exchanged(c, d, 1), _exchanged(e, f, 1), _exchanged(g, h, 1)
    (a, c), (b, d), (e, g), (f, h) = _exchanged(a, c, 2), _exchanged(b, d, 2), _exchanged(e, g, 2), _exchanged(f, h, 2)
    (a, e), (b, f), (c, g), (d, h) = _exchanged(a, e, 4), _exchanged(b, f, 4), _exchanged(c, g, 4), _exchanged(d, h, 4)
    return a, b, c, d, e, f, g, h


@inlined
def totals(a, b, c, d, e, f, g, h):  # type: ignore[no-untyped-def]
    """Return the sums of eight vectors, each always added in the same order."""
    ab, cd, ef, gh = _pairs_added(a, b, 1), _pairs_added(c, d, 1), _pairs_added(e, f, 1), _pairs_added(g, h, 1)
    return _pairs_added(_pairs_added(ab, cd, 2), _pairs_added(ef, gh, 2), 4)


@intrinsic
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
