"""Find the functions of a checkout that are 3DGS's SSIM, from their values on small images."""

from __future__ import annotations

import math
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

import libcst as cst
import numpy as np

from legs_adapters.code.interpreter.functions import Interpreter
from legs_adapters.code.interpreter.library import Raised, Unknown
from legs_adapters.code.module import Function
from legs_adapters.code.program import Program
from legs_adapters.terms.structural.arrays import Tensor, Torch, blurred

__all__ = ["Answer", "SsimFunctions"]

_SHAPES = ((3, 12, 15), (1, 3, 13, 12), (2, 3, 12, 11), (1, 14, 12))
_SAME = 1e-9  # of two values in double precision


class Answer(NamedTuple):
    """The kind of SSIM that a function is.

    Attributes:
        is_ssim: whether it is 3DGS's SSIM for these arguments; None where that is unknown.
        decider: where it is unknown, the node that stops the evaluation, with its function.
    """

    is_ssim: Optional[bool]
    decider: Optional[Tuple[Function, cst.CSTNode]] = None


class SsimFunctions:
    """The SSIM functions of one program, each evaluated once for the arguments that it is called with."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self._known: Dict[Tuple[Function, str], Answer] = {}

    def answer(
        self, function: Function, extras: Tuple[Any, ...] = (), keywords: Optional[Dict[str, Any]] = None
    ) -> Answer:
        """Decide whether a function of two images, with these further arguments, is 3DGS's SSIM.

        It is where the values are equal for random images of every shape that it takes, on a CPU and on a GPU. The
        function is rational in the pixels (see arrays.py), so equal values are not a coincidence.
        """
        named = keywords or {}
        key = function, repr((extras, sorted(named.items())))
        if key not in self._known:
            self._known[key] = self._evaluated(function, extras, named)
        return self._known[key]

    def _evaluated(self, function: Function, extras: Tuple[Any, ...], keywords: Dict[str, Any]) -> Answer:
        taken = False
        for images, expected in _EXAMPLES:
            for cuda in (False, True):
                torch = Torch(cuda)
                try:
                    with np.errstate(all="ignore"):
                        value = Interpreter(self.program, torch).call(function, (*images, *extras), keywords)
                except Raised:
                    break  # it takes no images of this shape
                except Unknown as unknown:
                    return Answer(None, (unknown.function, unknown.node))
                if not _is(value, expected):
                    return Answer(False)
                taken = True
                if not torch.depends_on_device:
                    break
        return Answer(taken)


def _is(value: Any, expected: float) -> bool:
    """Return whether a value is the expected number, as a tensor that has the images' gradient."""
    if not isinstance(value, Tensor) or not value.of_image or value.values.shape != ():
        return False
    return bool(abs(float(value.values) - expected) < _SAME)


def _ssim(first: np.ndarray, second: np.ndarray) -> float:
    """3DGS's SSIM: an 11x11 Gaussian window of sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2, the mean of all."""
    taps = np.array([math.exp(-((x - 5) ** 2) / (2 * 1.5**2)) for x in range(11)])
    window = np.outer(taps, taps) / taps.sum() ** 2

    def blur(images: np.ndarray) -> np.ndarray:
        return blurred(images, window, 5)

    mean1, mean2 = blur(first), blur(second)
    variances = blur(first**2) - mean1**2 + blur(second**2) - mean2**2
    covariance = blur(first * second) - mean1 * mean2
    similarity = (2 * mean1 * mean2 + 1e-4) * (2 * covariance + 9e-4)
    return float((similarity / ((mean1**2 + mean2**2 + 1e-4) * (variances + 9e-4))).mean())


def _examples() -> List[Tuple[Tuple[Tensor, Tensor], float]]:
    random = np.random.RandomState(0)
    pairs = [(random.rand(*shape), random.rand(*shape)) for shape in _SHAPES]
    return [((Tensor(first, True), Tensor(second, True)), _ssim(first, second)) for first, second in pairs]


_EXAMPLES = _examples()
