"""The metrics of a rendering, each one record: trainings, rows, tables, plots and the HTML page go through METRICS.

To add a metric, add a record. Rows that were trained before show it as missing.
"""

from __future__ import annotations

import math
from typing import Callable, Dict, Mapping, NamedTuple, Optional, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.lab.training.perceptual import NEEDS_LPIPS, has_lpips, lpips
from legs_loss.responses import response


class Metric(NamedTuple):
    """A measure of the difference of a rendering and its photograph.

    Attributes:
        key: its name in rows and files.
        label: its name for people.
        format: of a value in a table, as ``format()`` takes it.
        splits: the views it is computed for, "train", "test" (the held-out ones) or both.
        compute: (rendering, photograph), each [3, H, W] in [0, 1], to the value. Where the photograph has a mask, the
            rendering has the photograph's pixels there.
        differences: the splits for which `legs compare` tells differences between arms in the terminal; the HTML page
            tells all.
        available: whether its requirements are installed; None without requirements. Rows lack unavailable metrics, and
            tables omit columns that no row has.
        needs: how to make it available, in words.
        by_pixel: whether ``compute`` also takes the pixels that count, bool [H, W], or None.
    """

    key: str
    label: str
    format: str
    splits: Tuple[str, ...]
    compute: Callable[..., float]
    differences: Tuple[str, ...] = ()
    available: Optional[Callable[[], bool]] = None
    needs: str = ""
    by_pixel: bool = False

    def computes(self, split: str) -> bool:
        """Return whether the metric can be had of an image of a split."""
        return split in self.splits and (self.available is None or self.available())

    def column(self, split: str) -> str:
        """Return the head of its column: with the split in front, where it has two."""
        return self.label if len(self.splits) == 1 else f"{'train' if split == 'train' else 'held-out'} {self.label}"


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


def _both(pixels: Tensor, counts: Optional[Tensor]) -> Tensor:
    return pixels if counts is None else pixels & counts


def _ssim(prediction: Tensor, target: Tensor) -> float:
    from legs_loss.kernels.contract import SSIM
    from legs_loss.kernels.numba_loss import BACKEND

    return float(BACKEND.loss(SSIM, prediction, target))  # many times as fast as torch's


METRICS: Mapping[str, Metric] = {
    metric.key: metric
    for metric in (
        Metric("psnr", "PSNR", ".2f", ("train", "test"), psnr, differences=("train", "test"), by_pixel=True),
        Metric("ssim", "SSIM", ".4f", ("train", "test"), _ssim, differences=("test",)),
        Metric(
            "psnr_strong",
            "strongest 10%",  # PSNR of the pixels with the strongest Laplacian response of the photograph
            ".2f",
            ("test",),
            lambda prediction, target, counts: psnr(prediction, target, _both(strongest(target), counts)),
            differences=("test",),
            by_pixel=True,
        ),
        Metric(
            "psnr_rest",
            "the rest",  # PSNR of all others
            ".2f",
            ("test",),
            lambda prediction, target, counts: psnr(prediction, target, _both(~strongest(target), counts)),
            by_pixel=True,
        ),
        Metric("lpips", "LPIPS", ".4f", ("train", "test"), lpips, ("test",), has_lpips, NEEDS_LPIPS),
    )
}


def left_out() -> str:
    """Return one line on the metrics that are not computed here and what they need, "" where all are."""
    missing = [f"{metric.label} ({metric.needs})" for metric in METRICS.values() if not metric.computes("test")]
    return f"Left out: {'; '.join(missing)}." if missing else ""


def score(prediction: Tensor, target: Tensor, split: str = "test", counts: Optional[Tensor] = None) -> Dict[str, float]:
    """Return by key the metrics of one rendering [3, H, W] (clipped to [0, 1]) of a photograph of a split.

    counts: bool [H, W], the pixels that count; the rendering has the photograph's pixels elsewhere.
    """
    prediction = prediction.clamp(0.0, 1.0)
    return {
        key: metric.compute(prediction, target, *((counts,) if metric.by_pixel else ()))
        for key, metric in METRICS.items()
        if metric.computes(split)
    }


def mean_scores(scores: Sequence[Mapping[str, float]]) -> Dict[str, float]:
    """Return the mean over views of each metric, as the field reports them.

    Raises:
        LegsError: there is no view.
    """
    if not scores:
        raise LegsError("there is no view to score")
    return {key: sum(values[key] for values in scores) / len(scores) for key in scores[0]}
