"""WeightSpec: which weight map a loss uses; and the presets, by name."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from numbers import Real
from types import MappingProxyType
from typing import Any, Dict, Mapping, Tuple, Union

from legs_loss.curves import curve
from legs_loss.errors import LegsError, did_you_mean
from legs_loss.operators import check_operator

# The least and the largest of each number. In float32 a larger factor overflows in the sum over an image, and a smaller
# eps is 0: both give NaN.
_RANGES: Dict[str, Tuple[Any, Any, str]] = {
    "beta": (0.0, 1e6, "at least 0 and at most 1e6"),
    "percentile": (sys.float_info.min, 100.0, "above 0 and at most 100"),
    "eps": (1e-30, sys.float_info.max, "at least 1e-30"),
    "noise_floor": (0.0, 1e6, "at least 0 and at most 1e6"),
    "smooth": (0.0, 100.0, "in [0, 100]"),
}


def check_number(name: str, value: Any) -> None:
    """Check a number of a spec, by the name of its setting.

    Raises:
        LegsError: it is no number, or out of range.
    """
    least, largest, range_ = _RANGES[name]
    if not isinstance(value, Real) or isinstance(value, bool):
        raise LegsError(f"{name} must be a number, got {repr(value)[:100]}")
    if not least <= value <= largest:
        raise LegsError(f"{name} must be {range_}, got {value!r}")


@dataclass(frozen=True)
class WeightSpec:
    """The settings of W = 1 + beta * f(E^). The defaults are the preset "legs".

    Attributes:
        operator: of the response, a name of :data:`legs_loss.OPERATORS`.
        p: the norm over channels (and over a gradient's directions): 1, 2 or inf.
        curve: a registered curve's name, such as "C3", or one of your own.
        beta: in [0, 1e6], the weight of the strongest response, minus 1; 0 is 3DGS's own loss.
        percentile: in (0, 100]: the response that counts as 1; 100 is the maximum, as in the paper. Stronger
            responses are clamped to 1.
        normalise: "none", as in the paper, or "mean": each map is divided by its mean, so that it changes the
            distribution of weight, but not the scale of the L1 term.
        eps: in the normalisation's denominator, at least 1e-30.
        over: what the response is normalised over: "image", as in the paper, or "scene": the response that counts as 1
            is the median over views of each one's percentile, so that a photograph out of focus gets small weights
            beside sharp ones. ``legs precompute`` knows all views; without its maps a training stops
            (:mod:`legs_loss.responses`).
        noise_floor: in [0, 1e6], only over "scene": this multiple of the median response, the view's or the scene's,
            whichever is larger, is subtracted from the response. 3 removes most noise.
        smooth: in [0, 100], the standard deviation in pixels of a Gaussian before the operator.

    Raises:
        LegsError: a setting is unknown or out of range.

    Examples:
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
    over: str = "image"
    noise_floor: float = 0.0
    smooth: float = 0.0

    def __post_init__(self) -> None:
        check_operator(self.operator, self.p)
        curve(self.curve)
        for name in _RANGES:
            check_number(name, getattr(self, name))
        for name, words in (("normalise", ("none", "mean")), ("over", ("image", "scene"))):
            value = getattr(self, name)
            if not (isinstance(value, str) and value in words):
                raise LegsError(f'{name} must be "{words[0]}" or "{words[1]}", got {value!r}')
        if self.over == "image" and self.noise_floor > 0.0:
            raise LegsError('noise_floor goes with over="scene": a single image cannot separate noise from texture')

    @property
    def unweighted(self) -> bool:
        """Return whether the weight is 1 everywhere: 3DGS's own loss."""
        return self.beta == 0.0


Spec = Union[str, WeightSpec]

PRESETS: Mapping[str, WeightSpec] = MappingProxyType(
    {
        "3dgs": WeightSpec(beta=0.0),
        "eggs": WeightSpec(operator="sobel", curve="C1"),
        "legs-l": WeightSpec(curve="C1"),
        "legs": WeightSpec(curve="C3"),
        "legs-robust": WeightSpec(curve="C3", percentile=99.0, over="scene", noise_floor=3.0, smooth=0.7),
    }
)


def as_spec(spec: Spec) -> WeightSpec:
    """Return the spec itself, or the preset of that name.

    Raises:
        LegsError: no preset has that name.

    Examples:
        >>> as_spec("eggs").operator
        'sobel'
    """
    if isinstance(spec, WeightSpec):
        return spec
    try:
        return PRESETS[spec]
    except (KeyError, TypeError):
        choice = ", ".join(PRESETS) + did_you_mean(spec, PRESETS)
        raise LegsError(f"no preset is named {spec!r}: choose one of {choice}") from None
