"""The types of vectors, and Python's operators on them."""

from __future__ import annotations

import operator
from typing import Any, Dict, Sequence, Tuple

from llvmlite import ir
from numba import extending, types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import lower_builtin, models, register_model

LANES = 8

FLOATS: Any = ir.VectorType(ir.FloatType(), LANES)
INTEGERS: Any = ir.VectorType(ir.IntType(32), LANES)
MASK: Any = ir.VectorType(ir.IntType(1), LANES)


class _Vector(types.Type):
    def __init__(self, name: str, lanes: Any) -> None:
        super().__init__(name=name)
        self.lanes = lanes


float8: _Vector = _Vector("float8", FLOATS)
integer8: _Vector = _Vector("integer8", INTEGERS)
mask8: _Vector = _Vector("mask8", MASK)
KINDS: Dict[Any, _Vector] = {types.float32: float8, types.int32: integer8}


def intrinsic(function: Any) -> Any:
    """Make a callable from a function that generates LLVM code: numba's decorator, typed."""
    return extending.intrinsic(function)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, kind.lanes)


class _First(ConcreteTemplate):
    """Cases of an operator that numba tries before its own: what is of this processor, not of any, comes first."""

    metadata = {"target": "cpu"}


def _operator(symbol: Any, kind: Any, instruction: str) -> None:
    class Template(_First):
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
    (operator.lshift, integer8, "shl"),
    (operator.and_, mask8, "and_"),
):
    _operator(_symbol, _kind, _instruction)


class _Negative(_First):
    cases = [signature(float8, float8)]


infer_global(operator.neg)(_Negative)


@lower_builtin(operator.neg, float8)
def _negative(context: Any, builder: Any, sig: Any, args: Sequence[Any]) -> Any:
    return builder.fneg(*args)
