"""PSNR and SSIM of a rendering, and PSNR apart for the pixels with the strongest response and for the rest."""

from __future__ import annotations

import math
from typing import NamedTuple, Optional, Sequence

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.response import response

__all__ = ["Scores", "mean_scores", "psnr", "score", "strongest"]


class Scores(NamedTuple):
    """Of one view, or the means over views (as the field reports them): dB, and SSIM at most 1."""

    psnr: float
    ssim: float
    psnr_strong: float  # over the 10% of the pixels with the strongest Laplacian response of the photograph
    psnr_rest: float  # over all others


def psnr(prediction: Tensor, target: Tensor, mask: Optional[Tensor] = None) -> float:
    """Return 10 log10(1 / mean squared error) of images [C, H, W] in [0, 1], inf for equal ones.

    mask: bool [H, W], the pixels that count.

    >>> round(psnr(torch.zeros(3, 4, 4), torch.full((3, 4, 4), 0.1)), 4)
    20.0
    """
    squares = (prediction - target).double().square()
    error = float(squares.mean() if mask is None else squares[:, mask].mean())
    return 10.0 * math.log10(1.0 / error) if error > 0 else math.inf


def strongest(image: Tensor, fraction: float = 0.1) -> Tensor:
    """Return where an image [C, H, W] has its strongest Laplacian responses: bool [H, W], ``fraction`` of it true.

    >>> dot = torch.zeros(1, 5, 5)
    >>> dot[0, 2, 2] = 1.0
    >>> strongest(dot, 0.2).int()  # the dot and its four neighbours
    tensor([[0, 0, 0, 0, 0],
            [0, 0, 1, 0, 0],
            [0, 1, 1, 1, 0],
            [0, 0, 1, 0, 0],
            [0, 0, 0, 0, 0]], dtype=torch.int32)
    """
    strength = response(image)[0]
    ranked = torch.sort(strength.flatten(), descending=True, stable=True).indices
    mask = torch.zeros(strength.numel(), dtype=torch.bool)
    mask[ranked[: max(1, round(fraction * strength.numel()))]] = True
    return mask.reshape(strength.shape)


def score(prediction: Tensor, target: Tensor) -> Scores:
    """Return the scores of one rendering [3, H, W] (clipped to [0, 1]) against its photograph."""
    from legs_loss.kernels.numba_loss import fused_loss

    prediction = prediction.clamp(0.0, 1.0)
    mask = strongest(target)
    return Scores(
        psnr(prediction, target),
        1.0 - float(fused_loss(prediction, target, None, 1.0)),  # SSIM alone, many times as fast as torch's
        psnr(prediction, target, mask),
        psnr(prediction, target, ~mask),
    )


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """Return the mean over views of each score.

    Raises:
        LegsError: there is no view.
    """
    if not scores:
        raise LegsError("there is no view to score")
    return Scores(*(sum(values) / len(scores) for values in zip(*scores)))
