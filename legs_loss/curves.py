"""Curves: functions f of a normalised response, [0, 1] -> [0, 1], that shape the weight.

The LEGS paper defines C1 as the identity and shows C2 to C5 only as a picture. The formulas of C2 to C5 are
this project's identification of that picture, not the paper's text; docs/method.md describes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Callable, Dict, Tuple

from legs_loss.errors import LegsError, did_you_mean

if TYPE_CHECKING:
    from torch import Tensor

Curve = Callable[["Tensor"], "Tensor"]

# The curves, each written once: torch's function, numba's and CUDA's code are made from it. A formula has numbers,
# + - * / and brackets, x, and the functions of _TORCH; a backend that lacks one of these leaves that curve to torch.
FORMULAS: Dict[str, str] = {
    "C1": "x",
    "C2": "x * x",
    "C3": "sqrt(x)",
    "C4": "x * x * (3 - 2 * x)",  # smoothstep
    "C5": "unit(0.5 - sin(asin(1 - 2 * x) / 3))",  # its inverse; rounding can leave [0, 1] by one ulp at its ends
}
_TORCH: Dict[str, Any] = {
    "sqrt": lambda x: x.sqrt(),
    "sin": lambda x: x.sin(),
    "asin": lambda x: x.asin(),
    "unit": lambda x: x.clamp(0.0, 1.0),
}
_CURVES: Dict[str, Curve] = {name: eval(f"lambda x: {formula}", _TORCH) for name, formula in FORMULAS.items()}


def curve(name: str) -> Curve:
    """Return the curve registered under ``name``.

    Raises:
        LegsError: no curve has that name.

    Examples:
        >>> import torch
        >>> curve("C3")(torch.tensor([0.0, 0.25, 1.0]))
        tensor([0.0000, 0.5000, 1.0000])
    """
    try:
        return _CURVES[name]
    except (KeyError, TypeError):
        choice = f"{', '.join(_CURVES)}, or add your own with register_curve(name, function)"
        raise LegsError(f"no curve is named {name!r}: choose one of {choice}{did_you_mean(name, _CURVES)}") from None


def curve_names() -> Tuple[str, ...]:
    """Return the names of all registered curves, the built-in ones first."""
    return tuple(_CURVES)


def register_curve(name: str, function: Curve) -> None:
    """Add a curve of your own, for ``WeightSpec(curve=name)``.

    Args:
        name: a new name; the built-in curves cannot be replaced, so that "C3" always means C3.
        function: maps a float tensor of any shape with values in [0, 1] to one of the same shape, in [0, 1].

    Raises:
        LegsError: the name is taken, or the function leaves [0, 1] or changes the shape.

    Examples:
        >>> import torch
        >>> register_curve("cube-root", lambda x: x ** (1 / 3))
        >>> curve("cube-root")(torch.tensor([0.125]))
        tensor([0.5000])
    """
    if not isinstance(name, str) or not name:
        raise LegsError(f"a curve's name is a non-empty string, got {name!r}")
    if name in _CURVES:
        raise LegsError(f"a curve named {name!r} exists already: choose another name")
    import torch

    x = torch.linspace(0.0, 1.0, 257)
    y = function(x.clone()) if callable(function) else function
    if not isinstance(y, torch.Tensor) or y.shape != x.shape or y.is_complex():
        raise LegsError(f"curve {name!r} must return a real tensor of its input's shape, got {y!r}")
    if not bool(((y >= 0.0) & (y <= 1.0)).all()):
        span = f"from {float(y.min()):g} to {float(y.max()):g}"
        raise LegsError(f"curve {name!r} must map [0, 1] into [0, 1]: its values run {span}")
    _CURVES[name] = function
