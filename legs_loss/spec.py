"""WeightSpec: which weight map a loss uses; and the presets, by name."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import Mapping, Union

from legs_loss.curves import curve
from legs_loss.errors import LegsError, did_you_mean
from legs_loss.operators import check_operator

__all__ = ["PRESETS", "Spec", "WeightSpec", "as_spec"]


def _check_number(name: str, value: float, fits: bool, range_: str) -> None:
    if not fits:
        raise LegsError(f"{name} must be {range_}, got {value!r}")


@dataclass(frozen=True)
class WeightSpec:
    """The settings of W = 1 + beta * f(E^). The defaults are the preset "legs".

    Attributes:
        operator: of the response, a name of :data:`legs_loss.OPERATORS`.
        p: the norm over channels (and over a gradient's directions): 1, 2 or inf.
        curve: a registered curve's name, "C1" to "C5" or one of your own.
        beta: >= 0, how far the strongest response lifts the weight; 0 is 3DGS's own loss.
        percentile: in (0, 100]: the response that counts as 1; 100 is the maximum, as in the paper. Stronger
            responses are clamped to 1.
        normalise: "none", as in the paper, or "mean": each map is divided by its mean, so that it moves weight
            between pixels without scaling the L1 term.
        eps: > 0, in the normalisation's denominator.

    Raises:
        LegsError: a setting is unknown or out of range.

    Example:
        >>> from dataclasses import replace
        >>> replace(as_spec("legs"), beta=4.0).curve
        'C3'
    """

    operator: str = "laplacian"
    p: float = 2.0
    curve: str = "C3"
    beta: float = 10.0
    percentile: float = 100.0
    normalise: str = "none"
    eps: float = 1e-8

    def __post_init__(self) -> None:
        check_operator(self.operator, self.p)
        curve(self.curve)
        _check_number("beta", self.beta, 0.0 <= self.beta < float("inf"), "at least 0")
        _check_number("percentile", self.percentile, 0.0 < self.percentile <= 100.0, "above 0 and at most 100")
        _check_number("eps", self.eps, 0.0 < self.eps < float("inf"), "above 0")
        if self.normalise not in ("none", "mean"):
            raise LegsError(f'normalise must be "none" or "mean", got {self.normalise!r}')


Spec = Union[str, WeightSpec]

PRESETS: Mapping[str, WeightSpec] = MappingProxyType(
    {
        "3dgs": WeightSpec(beta=0.0),
        "eggs": WeightSpec(operator="sobel", curve="C1"),
        "legs-l": WeightSpec(curve="C1"),
        "legs": WeightSpec(curve="C3"),
    }
)


def as_spec(spec: Spec) -> WeightSpec:
    """Return the spec itself, or the preset of that name.

    Raises:
        LegsError: no preset has that name.

    Example:
        >>> as_spec("eggs").operator
        'sobel'
    """
    if isinstance(spec, WeightSpec):
        return spec
    try:
        return PRESETS[spec]
    except (KeyError, TypeError):
        raise LegsError(
            f"no preset is named {spec!r}: choose one of {', '.join(PRESETS)}, or give a WeightSpec"
            + did_you_mean(spec, PRESETS)
        ) from None
