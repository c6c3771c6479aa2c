"""The tables of operators.py and curves.py as kernels take them: numbers by order, formulas in a language's words."""

from __future__ import annotations

import re
from typing import Callable, Dict, Optional, Tuple

from legs_loss import operators
from legs_loss.curves import FORMULAS
from legs_loss.operators import OPERATORS, Operator, gradient

NORMS: Dict[float, int] = {p: number for number, p in enumerate(operators.NORMS, 1)}
CURVES: Dict[str, int] = {name: number for number, name in enumerate(FORMULAS, 1)}
FOUR, EIGHT, GRADIENT = 1, 2, 3  # kinds of stencil: a Laplacian of four neighbours, of eight, a gradient


def _stencil_of(operator: Operator) -> Optional[Tuple[int, float, float]]:
    """Return the kind of an operator's stencils, and a gradient's weights; None where kernels have no such kind."""
    if operator.reach != 1:
        return None
    (_, _, corner), (_, _, side), _ = operator.stencils[0]
    if operator.stencils == gradient(((-corner, 0, corner), (-side, 0, side), (-corner, 0, corner))):
        return GRADIENT, float(corner), float(side)
    if operator.stencils == (((corner, 1, corner), (1, -4 - 4 * corner, 1), (corner, 1, corner)),) and corner in (0, 1):
        return (EIGHT if corner else FOUR), 0.0, 0.0
    return None


_FOUND = ((name, _stencil_of(operator)) for name, operator in OPERATORS.items())
# By operator: the kind, the weights of a gradient's outer rows and of its middle one.
STENCILS: Dict[str, Tuple[int, float, float]] = {name: found for name, found in _FOUND if found is not None}


def formulas_in(words: Dict[str, str], number: Callable[[str], str]) -> Dict[str, str]:
    """Return the formulas of the curves in another language, but of those for which it lacks a function.

    Args:
        words: the language's name of x and of each function that it has.
        number: writes a number, which it is given as 3.0.

    Examples:
        >>> formulas_in({"x": "y", "sqrt": "root"}, "{}f".format)["C4"]
        'y * y * (3.0f - 2.0f * y)'
    """

    def written(formula: str) -> str:
        return re.sub(r"[a-z]\w*|[\d.]+", lambda token: words.get(token[0]) or number(str(float(token[0]))), formula)

    known = {name: formula for name, formula in FORMULAS.items() if {*re.findall(r"[a-z]\w*", formula)} <= {*words}}
    return {name: written(formula) for name, formula in known.items()}
