"""The whole LEGS loss and its gradient in one pass over the images, on a GPU.

The loss is a scalar, so its gradient is known as soon as the images are: the forward pass computes both, and the
backward pass scales. Each program takes a square of one view and everything within its reach, channel after channel:

    x, y, x^2 + y^2, xy -> blur -> SSIM and its three slopes -> blur -> gradient

A blur of a square is the product B X B with the banded matrix B of the window's taps; what lies too near to the edge
of the square comes out wrong and is not used. The square's weights are computed from the target once, for all of its
channels; for that a first pass over the target finds the least and the greatest response of each view.

Bytes that must move, in float32: prediction and target are read and the gradient is written once, 12 a value; the first
pass reads the target once more, 4 a value; a stored map instead of it is 4 a pixel. Squares overlap, so the caches
serve (64 / 44)^2 = 2.1 times what must be read.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Optional, Tuple, Union

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from legs_loss.errors import LegsError
from legs_loss.images import check_values, shape_of
from legs_loss.spec import WeightSpec
from legs_loss.ssim import C1, C2, SIGMA, WINDOW_SIZE
from legs_loss.weights import weight_map

__all__ = ["fused_loss"]

_REACH = tl.constexpr(WINDOW_SIZE // 2)
_SIZE = tl.constexpr(64)  # of a square with its reach
_CORE = tl.constexpr(64 - 4 * (WINDOW_SIZE // 2))
_C1, _C2 = tl.constexpr(C1), tl.constexpr(C2)
# SSIM's variances are small differences: tf32's three digits would be lost in them. Triton's other choice is "tf32x3".
_PRECISION = tl.constexpr("ieee")

_NORMS = {1.0: 1, 2.0: 2, float("inf"): 3}
# C5 needs an arcsine; it and curves of the user's own are applied by torch, to a map.
_CURVES = {"C1": 1, "C2": 2, "C3": 3, "C4": 4}


def fused_loss(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec, None] = None,
    lambda_dssim: float = 0.2,
) -> Tensor:
    """Return (1 - lambda) * L_w + lambda * (1 - SSIM), as :func:`legs_loss.legs_loss` with zero padding.

    Args:
        prediction: float32, float16 or bfloat16, [C, H, W] or [B, C, H, W]. All arithmetic is in float32.
        target: the same shape, any of these types; no gradient flows to it.
        weight: [1, H, W] or [B, 1, H, W]; a spec computes it from the target (without a map in memory where the curve
            is one of C1 to C4, the percentile 100 and ``normalise`` "none"); None is 1 everywhere.
        lambda_dssim: the share of D-SSIM.

    Returns:
        A float32 scalar, differentiable once in the prediction. It repeats bit for bit. Nothing waits for the device.
    """
    if isinstance(weight, WeightSpec):
        if not (weight.curve in _CURVES and weight.percentile == 100.0 and weight.normalise == "none"):
            weight = weight_map(target, weight)
        elif target.device.type == "cpu":
            check_values(target, "target")
    return _FusedLoss.apply(prediction, target, weight, lambda_dssim)


class _FusedLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        prediction: Tensor,
        target: Tensor,
        weight: Union[Tensor, WeightSpec, None],
        lambda_dssim: float,
    ) -> Tensor:
        ctx.inputs = prediction.detach(), target.detach(), weight, lambda_dssim
        loss, ctx.gradient = _loss_and_gradient(prediction, target, weight, lambda_dssim, ctx.needs_input_grad[0])
        return loss

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> Tuple[Optional[Tensor], ...]:
        # The gradient is handed over, not copied; a second backward of a retained graph makes it anew.
        gradient, ctx.gradient = ctx.gradient, None
        if gradient is None:
            prediction, target, weight, lambda_dssim = ctx.inputs
            gradient = _loss_and_gradient(prediction, target, weight, lambda_dssim, True)[1]
            assert gradient is not None
        # Scaled first and rounded to half precision then: the steps of a mean over a photograph are too small for it.
        return gradient.mul_(grad_output).to(ctx.inputs[0].dtype), None, None, None


def _loss_and_gradient(
    prediction: Tensor,
    target: Tensor,
    weight: Union[Tensor, WeightSpec, None],
    lambda_dssim: float,
    wanted: bool,
) -> Tuple[Tensor, Optional[Tensor]]:
    channels, height, width = prediction.shape[-3:]
    values = prediction.numel()
    views = values // (channels * height * width)
    x, y = prediction.contiguous(), target.contiguous()
    grid = (triton.cdiv(height, _CORE.value) * triton.cdiv(width, _CORE.value), views)
    # What is absent is given some pointer, and not read.
    maps, map_stride, ranges, kind = y, 0, y, 0
    spec = weight if isinstance(weight, WeightSpec) else WeightSpec()
    settings = {"OPERATOR": spec.operator, "NORM": _NORMS[spec.p]}
    if isinstance(weight, WeightSpec):
        kind, ranges = 2, _ranges(y, (views, channels, height, width), grid, spec, settings)
    elif weight is not None:
        kind, maps = 1, weight.detach().to(torch.float32).contiguous()
        if maps.numel() not in (height * width, views * height * width):
            raise LegsError(f"weight {shape_of(weight)} does not fit images {shape_of(prediction)}")
        map_stride = height * width if maps.numel() > height * width else 0
    gradient = torch.empty(x.shape, dtype=torch.float32, device=x.device) if wanted else x
    sums = torch.empty(2, grid[1], grid[0], dtype=torch.float32, device=x.device)
    _loss_of_a_square[grid](
        x,
        y,
        _band(x.device),
        maps,
        map_stride,
        ranges,
        gradient,
        sums,
        channels,
        height,
        width,
        (1.0 - lambda_dssim) / values,
        -lambda_dssim / values,
        spec.beta,
        KIND=kind,
        CURVE=_CURVES.get(spec.curve, 0),
        WANTED=wanted,
        **settings,
    )
    absolute, similarity = sums.double().sum((1, 2)) / values
    loss = (1.0 - lambda_dssim) * absolute + lambda_dssim * (1.0 - similarity)
    return loss.to(torch.float32), gradient if wanted else None


def _ranges(y: Tensor, shape: Tuple[int, ...], grid: Tuple[int, int], spec: WeightSpec, settings: Any) -> Tensor:
    """Return of each view the least response and max - min + eps, [B, 2]; NaN where the view has a NaN."""
    _, channels, height, width = shape
    found = torch.empty(3, grid[1], grid[0], dtype=torch.float32, device=y.device)
    _range_of_a_square[grid](y, found, channels, height, width, **settings)
    low, high, poison = found[0].amin(1), found[1].amax(1), found[2].sum(1)
    return torch.stack([low + poison, (high - low) + (spec.eps + poison)], 1).contiguous()


@lru_cache(maxsize=None)
def _band(device: torch.device) -> Tensor:
    distance = torch.arange(_SIZE.value)[:, None] - torch.arange(_SIZE.value)[None, :]
    taps = torch.exp(-(torch.arange(-_REACH.value, _REACH.value + 1, dtype=torch.float64) ** 2) / (2 * SIGMA**2))
    taps = taps / taps.sum()
    band = torch.where(
        distance.abs() <= _REACH.value, taps[distance.clamp(-_REACH.value, _REACH.value) + _REACH.value], 0.0
    )
    return band.to(torch.float32).to(device)


@triton.jit
def _loss_of_a_square(  # type: ignore[no-untyped-def]
    x,
    y,
    band,
    maps,
    map_stride,
    ranges,
    gradient,
    sums,
    channels,
    height,
    width,
    l1_scale,
    ssim_scale,
    beta,
    KIND: tl.constexpr,
    CURVE: tl.constexpr,
    WANTED: tl.constexpr,
    OPERATOR: tl.constexpr,
    NORM: tl.constexpr,
):
    square, view = tl.program_id(0), tl.program_id(1)
    across = tl.cdiv(width, _CORE)
    near = tl.arange(0, _SIZE)
    rows = (square // across * _CORE - 2 * _REACH + near)[:, None]
    columns = (square % across * _CORE - 2 * _REACH + near)[None, :]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    in_core = (near >= 2 * _REACH) & (near < 2 * _REACH + _CORE)
    core = inside & in_core[:, None] & in_core[None, :]
    b = tl.load(band + near[:, None] * _SIZE + near[None, :])

    weight = tl.full((_SIZE, _SIZE), 1.0, tl.float32)
    if KIND == 1:
        weight = tl.load(maps + view.to(tl.int64) * map_stride + rows * width + columns, mask=core, other=1.0)
    if KIND == 2:
        low, span = tl.load(ranges + view * 2), tl.load(ranges + view * 2 + 1)
        strength = _response(y, view, channels, height, width, rows, columns, core, OPERATOR, NORM)
        normalised = tl.where(core, (strength - low) / span, 0.0)
        weight = 1.0 + beta * _curve(normalised, CURVE)

    absolute = tl.zeros((_SIZE, _SIZE), tl.float32)
    similar = tl.zeros((_SIZE, _SIZE), tl.float32)
    for channel in range(channels):
        plane = (view.to(tl.int64) * channels + channel) * height * width
        at = plane + rows * width + columns
        u = tl.load(x + at, mask=inside, other=0.0).to(tl.float32)
        v = tl.load(y + at, mask=inside, other=0.0).to(tl.float32)
        mean1, mean2 = _blur(u, b), _blur(v, b)
        squares, product = _blur(u * u + v * v, b), _blur(u * v, b)
        mean12, means = mean1 * mean2, mean1 * mean1 + mean2 * mean2
        above1, above2 = 2.0 * mean12 + _C1, 2.0 * (product - mean12) + _C2
        below1, below2 = means + _C1, (squares - means) + _C2
        similarity = above1 * above2 / (below1 * below2)
        similar += tl.where(core, similarity, 0.0)
        difference = u - v
        absolute += tl.where(core, weight * tl.abs(difference), 0.0)
        if WANTED:
            slope1 = 2.0 * (
                mean2 * (above2 - above1) / (below1 * below2) + mean1 * similarity * (1.0 / below2 - 1.0 / below1)
            )
            slope2 = -2.0 * similarity / below2
            slope3 = 2.0 * above1 / (below1 * below2)
            slope1 = _blur(tl.where(inside, slope1, 0.0), b)
            slope2 = _blur(tl.where(inside, slope2, 0.0), b)
            slope3 = _blur(tl.where(inside, slope3, 0.0), b)
            sign = tl.where(difference > 0.0, 1.0, 0.0) - tl.where(difference < 0.0, 1.0, 0.0)
            slope = ssim_scale * (slope1 + u * slope2 + v * slope3) + l1_scale * weight * sign
            tl.store(gradient + at, slope, mask=core)
    place = view * tl.num_programs(0) + square
    tl.store(sums + place, tl.sum(tl.sum(absolute, 1), 0))
    tl.store(sums + tl.num_programs(1) * tl.num_programs(0) + place, tl.sum(tl.sum(similar, 1), 0))


@triton.jit
def _range_of_a_square(y, found, channels, height, width, OPERATOR: tl.constexpr, NORM: tl.constexpr):  # type: ignore[no-untyped-def]
    square, view = tl.program_id(0), tl.program_id(1)
    across = tl.cdiv(width, _CORE)
    near = tl.arange(0, _SIZE)
    rows = (square // across * _CORE + near)[:, None]
    columns = (square % across * _CORE + near)[None, :]
    core = (rows < height) & (columns < width) & (near < _CORE)[:, None] & (near < _CORE)[None, :]
    strength = _response(y, view, channels, height, width, rows, columns, core, OPERATOR, NORM)
    place = view * tl.num_programs(0) + square
    programs = tl.num_programs(1) * tl.num_programs(0)
    tl.store(found + place, tl.min(tl.min(tl.where(core, strength, float("inf")), 1), 0))
    tl.store(found + programs + place, tl.max(tl.max(tl.where(core, strength, 0.0), 1), 0))
    tl.store(found + 2 * programs + place, tl.sum(tl.sum(tl.where(core, strength * 0.0, 0.0), 1), 0))


@triton.jit
def _blur(image, band):  # type: ignore[no-untyped-def]
    down = tl.dot(band, image, input_precision=_PRECISION)
    return tl.dot(down, band, input_precision=_PRECISION)


@triton.jit
def _curve(normalised, CURVE: tl.constexpr):  # type: ignore[no-untyped-def]
    if CURVE == 2:
        normalised = normalised * normalised
    if CURVE == 3:
        normalised = tl.sqrt(normalised)
    if CURVE == 4:
        normalised = normalised * normalised * (3.0 - 2.0 * normalised)
    return normalised


@triton.jit
def _response(y, view, channels, height, width, rows, columns, core, OPERATOR: tl.constexpr, NORM: tl.constexpr):  # type: ignore[no-untyped-def]
    # Reflected at the border; differences are taken in an order that is exactly zero on a constant image.
    up, down = _folded(rows - 1, height) * width, _folded(rows + 1, height) * width
    here = rows * width
    left, right = _folded(columns - 1, width), _folded(columns + 1, width)
    first = tl.zeros((_SIZE, _SIZE), tl.float32)
    second = tl.zeros((_SIZE, _SIZE), tl.float32)
    for channel in range(channels):
        plane = y + (view.to(tl.int64) * channels + channel) * height * width
        north, south = _pixels(plane, up + columns, core), _pixels(plane, down + columns, core)
        west, east = _pixels(plane, here + left, core), _pixels(plane, here + right, core)
        if OPERATOR == "laplacian":
            middle = _pixels(plane, here + columns, core)
            first = _accumulated(first, ((north + south) + (west + east)) - 4.0 * middle, NORM)
        elif OPERATOR == "central":
            first = _accumulated(first, 0.5 * (east - west), NORM)
            second = _accumulated(second, 0.5 * (south - north), NORM)
        else:
            north_west, north_east = _pixels(plane, up + left, core), _pixels(plane, up + right, core)
            south_west, south_east = _pixels(plane, down + left, core), _pixels(plane, down + right, core)
            if OPERATOR == "laplacian8":
                middle = _pixels(plane, here + columns, core)
                cross = (north + south) + (west + east)
                diagonal = (north_west + south_east) + (north_east + south_west)
                first = _accumulated(first, (cross + diagonal) - 8.0 * middle, NORM)
            else:
                side: tl.constexpr = 1.0 if OPERATOR == "sobel" else 3.0
                centre: tl.constexpr = 2.0 if OPERATOR == "sobel" else 10.0
                across = side * ((north_east - north_west) + (south_east - south_west)) + centre * (east - west)
                along = side * ((south_west - north_west) + (south_east - north_east)) + centre * (south - north)
                first = _accumulated(first, across, NORM)
                second = _accumulated(second, along, NORM)
    if NORM == 3:
        strength = tl.maximum(first, second)
    else:
        strength = first + second
        if NORM == 2:
            strength = tl.sqrt(strength)
    return strength


@triton.jit
def _accumulated(sum, value, NORM: tl.constexpr):  # type: ignore[no-untyped-def]
    if NORM == 1:
        sum += tl.abs(value)
    elif NORM == 2:
        sum += value * value
    else:
        sum = tl.maximum(sum, tl.abs(value))
    return sum


@triton.jit
def _pixels(plane, at, core):  # type: ignore[no-untyped-def]
    return tl.load(plane + at, mask=core, other=0.0).to(tl.float32)


@triton.jit
def _folded(index, size):  # type: ignore[no-untyped-def]
    # One beyond the edge; a side of one pixel continues itself.
    index = tl.abs(index)
    index = tl.where(index >= size, 2 * size - 2 - index, index)
    return tl.maximum(index, 0)
