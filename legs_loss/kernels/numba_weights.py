"""The images of a call and the weights of their pixels, as the compiled functions take them."""

from __future__ import annotations

from typing import NamedTuple, Optional, Union

import numpy as np
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import check_values, shape_of
from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.numba_passes import extremes
from legs_loss.kernels.numba_response import (
    CURVES,
    Operator,
    Shape,
    Weighting,
    operator_of,
    supports_response,
    weight_row,
)
from legs_loss.spec import WeightSpec

__all__ = ["Images", "WeightSource", "images_of", "response_range", "source_of", "supports", "weights_of_row"]


class Images(NamedTuple):
    """A prediction and its target.

    x, y: float32 [views * channels * height * width], in this order.
    """

    x: np.ndarray
    y: np.ndarray
    views: int
    channels: int
    height: int
    width: int


class WeightSource(NamedTuple):
    """The source of weights: none (kind 0), a map (1), or the target (2).

    stored: kind 1: float32 [height * width] for all views, or [views * height * width].
    ranges: kind 2: float32 [views, 2]: the least response, and the greatest less the least plus eps.
    stencil, side, middle, norm: kind 2: an Operator's; a parallel loop takes no group in a group.
    curve, beta: kind 2: of the weight.
    """

    kind: int
    stored: np.ndarray
    ranges: np.ndarray
    stencil: int
    side: np.float32
    middle: np.float32
    norm: int
    curve: int
    beta: np.float32


_EMPTY, _ZERO = np.empty(0, np.float32), np.float32(0.0)
_NONE = WeightSource(0, _EMPTY, _EMPTY.reshape(0, 2), 0, _ZERO, _ZERO, 0, 0, _ZERO)


def images_of(prediction: Tensor, target: Tensor) -> Images:
    """Return images [C, H, W] or [B, C, H, W] as the compiled functions take them."""
    channels, height, width = prediction.shape[-3:]
    views = prediction.numel() // (channels * height * width)
    return Images(_flat(prediction), _flat(target), views, channels, height, width)


def supports(spec: WeightSpec) -> bool:
    """Return whether the weights of a spec can be made here; other specs' are made by torch, as a map."""
    known = WeightSpec(operator=spec.operator, p=spec.p, curve=spec.curve, beta=spec.beta, eps=spec.eps)
    return spec == known and supports_response(spec) and spec.curve in CURVES


def source_of(
    weight: Union[Tensor, WeightSpec, None], target: Tensor, images: Images, ranges: Optional[Tensor] = None
) -> WeightSource:
    """Return where the weights come from.

    Args:
        weight: a map [1, H, W] or [B, 1, H, W], a spec that is supported, or None.
        target: the images' target.
        ranges: what :func:`response_range` returned for it; None computes it.

    Raises:
        LegsError: a map that does not fit; a spec, and a target with NaN, infinity or plainly of 0..255.
    """
    if weight is None:
        return _NONE
    if isinstance(weight, WeightSpec):
        found = response_range(target, weight) if ranges is None else ranges.numpy().copy()
        found[:, 1] += np.float32(weight.eps)
        return WeightSource(2, _EMPTY, found, *operator_of(weight), CURVES[weight.curve], np.float32(weight.beta))
    stored, pixels = _flat(weight), images.height * images.width
    if stored.size not in (pixels, images.views * pixels):
        raise LegsError(f"weight {shape_of(weight)} does not fit images {shape_of(target)}")
    return _NONE._replace(kind=1, stored=stored)


def response_range(target: Tensor, spec: WeightSpec) -> np.ndarray:
    """Return of each view of [C, H, W] or [B, C, H, W] the least response, and the greatest less the least, [B, 2].

    Raises:
        LegsError: a target with NaN, infinity or plainly of 0..255.
    """
    found = extremes(_flat(target).reshape(-1, *target.shape[-3:]), spec)
    if not (found[:, 2].max() <= 1.0 and found[:, 3].sum() == 0.0):
        check_values(target)  # overshoots are fine; it raises for what is not
    return np.stack([found[:, 0], found[:, 1] - found[:, 0]], 1)


@compiled(fastmath=False)
def weights_of_row(images, source, piece, out, at):  # type: ignore[no-untyped-def]
    """Write the weights of a Piece of a row to out[at:], rounded up to whole vectors."""
    height, width = images.height, images.width
    if source.kind == 1:
        one_for_all = source.stored.size == height * width
        row = (piece.row if one_for_all else piece.view_index * height + piece.row) * width
        out[at : at + piece.right - piece.left] = source.stored[row + piece.left : row + piece.right]
    elif source.kind == 2:
        shape = Shape(images.views, images.channels, height, width)
        low, span = source.ranges[piece.view_index, 0], source.ranges[piece.view_index, 1]
        weighting = Weighting(source.curve, source.beta, low, span)
        operator = Operator(source.stencil, source.side, source.middle, source.norm)
        weight_row(images.y, shape, piece, operator, weighting, out, at)


def _flat(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().contiguous().numpy().reshape(-1)
