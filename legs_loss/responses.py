"""The response of a photograph to a second- or first-order operator, large at contours and thin structures.

    E = || op F ||_p        normalised per image: E^ = (E - min E) / (max E - min E + eps)

Source: the LEGS paper, its weight's definition (op = Laplacian); EGGS, arXiv 2404.09105 (op = gradient).

Or over a scene, by its levels: its noise and its strong contours, computed from two levels of each view's response.

The maximum response of a single image is a poor reference: blur lowers it, which raises the normalised rest; noise
raises all other responses. The medians of two levels over the views of a scene are more robust: the median response,
which is the noise where half of an image is smooth (the estimate of wavelet shrinkage), and a high percentile, a strong
contour. A view out of focus is then weak relative to its scene, and a dead pixel, the maximum, changes neither level.

    E~ = min(max(E - noise_floor * max(m, M), 0) / (S + eps), 1)    m: the view's median, M and S: the scene's levels

Source: this project's own; the median as an estimate of noise, subtracted, is Donoho and Johnstone's soft threshold.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import Dict, Iterable, List, Mapping, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from legs_loss.autograd import is_compiling
from legs_loss.images import read_layout
from legs_loss.operators import OPERATORS, Operator, Stencil, check_operator
from legs_loss.spec import WeightSpec, check_number

NEEDS_LEVELS = (
    "weights that are normalised over the scene need the levels of all its views, which {where}: run legs precompute "
    "SCENE --preset legs-robust, with the training's -r, {then}; or take a preset for single images, such as legs"
)

_CACHED = 1 << 17  # values of an image that are worked on at once


def response(
    image: Tensor,
    operator: str = "laplacian",
    p: float = 2.0,
    channels_last: Optional[bool] = None,
    smooth: float = 0.0,
) -> Tensor:
    """Return the response E = || op F ||_p of an image, one value a pixel.

    Args:
        image: floats, [H, W], [C, H, W] with any number of channels, [H, W, C], or batches of these; half precision is
            computed in float32.
        operator: a name of :data:`legs_loss.OPERATORS`, which has its stencils: a Laplacian or a gradient.
        p: 1, 2 or inf: the norm over channels, and for a gradient over its two directions too.
        channels_last: where the channel stands, for a shape that does not show it.
        smooth: the standard deviation in pixels of a Gaussian that the image is averaged with first.

    Returns:
        The image's shape with one channel, values >= 0, float32 (float64 for float64). The border is reflected
        (the edge pixel is not repeated), so the border of the image is not an edge. No gradient flows to the image.

    Raises:
        LegsError: not an image, one whose channel may be first or last, or an unknown operator or norm.

    Examples:
        >>> dot = torch.zeros(2, 5)
        >>> dot[0, 2] = 1.0
        >>> response(dot)
        tensor([[0., 1., 4., 1., 0.],
                [0., 0., 2., 0., 0.]])
    """
    layout = read_layout(image, channels_last)
    check_operator(operator, p)
    check_number("smooth", smooth)
    flat = layout.channels_first(image.detach())
    flat = flat.to(torch.promote_types(flat.dtype, torch.float32))
    if smooth > 0.0:
        # Operators do not respond to a constant: without it, the response of a flat image is exactly 0.
        flat = gaussian_blur(flat - flat[..., :1, :1], smooth)
    single = flat.dim() == 3
    strength = _strength(flat.unsqueeze(0) if single else flat, OPERATORS[operator], p)
    strength = strength[0] if single else strength
    return layout.restored(strength)


def normalise_response(response: Tensor, eps: float = 1e-8) -> Tensor:
    """Return E^ = (E - min E) / (max E - min E + eps), each image of a batch by itself.

    Args:
        response: [H, W], [1, H, W] or [B, 1, H, W], or channels-last, as :func:`response` returns it.
        eps: keeps a constant response at 0.

    Returns:
        The same shape, in [0, 1]. A NaN in an image makes all of its map NaN: it is never hidden.

    Examples:
        >>> normalise_response(torch.tensor([[[1.0, 2.0, 5.0]]]))
        tensor([[[0.0000, 0.2500, 1.0000]]])
    """
    over = tuple(range(max(0, response.dim() - 3), response.dim()))
    low = response.amin(over, keepdim=True)
    high = response.amax(over, keepdim=True)
    return (response - low).div_(high - low + eps)


def gaussian_blur(image: Tensor, sigma: float) -> Tensor:
    """Return an image averaged with a Gaussian of ``sigma`` pixels, cut off at 3 sigma, the border reflected.

    Args:
        image: [C, H, W] or [B, C, H, W].
        sigma: 0 leaves it as it is.

    Examples:
        >>> (100 * gaussian_blur(torch.tensor([[[0.0, 0.0, 1.0, 0.0, 0.0]]]), 0.5)).round()
        tensor([[[ 0., 11., 79., 11.,  0.]]])
    """
    if sigma == 0.0:
        return image
    reach = math.ceil(3.0 * sigma)
    steps = torch.arange(-reach, reach + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-0.5 * (steps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = _with_border(image.reshape(-1, 1, *image.shape[-2:]), reach)
    blurred = F.conv2d(F.conv2d(padded, kernel.reshape(1, 1, 1, -1)), kernel.reshape(1, 1, -1, 1))
    return blurred.reshape(image.shape)


def response_levels(strength: Tensor, spec: WeightSpec) -> Tensor:
    """Return the median and the ``spec.percentile`` of each response.

    Args:
        strength: E, [1, H, W] or [B, 1, H, W], or channels-last.
        spec: its percentile counts.

    Returns:
        [2] or [B, 2], on the same device; nothing waits for it.

    Examples:
        >>> response_levels(torch.tensor([[[0.0, 1.0, 2.0, 7.0, 9.0]]]), WeightSpec(percentile=80))
        tensor([2., 7.])
    """
    return torch.stack([percentile(strength, 50.0), percentile(strength, spec.percentile)], -1)


def scene_levels(levels: Iterable[Tensor]) -> Tensor:
    """Return the medians over views of their levels, [2].

    >>> scene_levels([torch.tensor([1.0, 8.0]), torch.tensor([2.0, 5.0]), torch.tensor([9.0, 1.0])])
    tensor([2., 5.])
    """
    return torch.stack(list(levels)).nanmedian(0).values


def over_scene(strength: Tensor, spec: WeightSpec, scene: Optional[Tensor] = None) -> Tensor:
    """Return the response normalised over its scene, E~ in [0, 1].

    Args:
        strength: E, [1, H, W] or [B, 1, H, W], or channels-last.
        spec: its percentile, noise_floor and eps count.
        scene: the scene's levels, [2]; without them these images are the scene.

    Returns:
        The same shape. A NaN in an image makes all of its map NaN.

    Examples:
        >>> spec = WeightSpec(over="scene", percentile=80, noise_floor=1.0)
        >>> over_scene(torch.tensor([[[0.0, 1.0, 2.0, 7.0, 9.0]]]), spec, torch.tensor([3.0, 10.0]))
        tensor([[[0.0000, 0.0000, 0.0000, 0.4000, 0.6000]]])
    """
    if scene is None:
        scene = scene_levels(response_levels(strength, spec).reshape(-1, 2))
    scene = scene.to(strength)
    # A texture removed by blur must not lower the floor: an image's level counts only above the scene's.
    floor = spec.noise_floor * torch.maximum(percentile(strength, 50.0), scene[0])
    floor = floor.reshape(*floor.shape, 1, 1, 1)
    return ((strength - floor).clamp(min=0.0) / (scene[1] + spec.eps)).clamp(max=1.0)


def percentile(values: Tensor, share: float) -> Tensor:
    """Return a percentile of each map [1, H, W] or [B, 1, H, W] by its nearest rank, [] or [B].

    Not by torch.quantile, which refuses images of more than 16 million pixels. A NaN in a map makes it NaN.
    """
    flat = values.flatten(-3)
    rank = max(1, math.ceil(share / 100.0 * flat.shape[-1]))
    found = flat.kthvalue(rank, dim=-1).values
    return torch.where(flat.sum(-1).isnan(), flat.sum(-1), found)


def _strength(image: Tensor, operator: Operator, p: float) -> Tensor:
    """Return the norm of an image [B, C, H, W] correlated with each stencil of an operator, [B, 1, H, W].

    Torch's convolution is not used, since its order of summation varies: here every pixel is computed by the same
    operations, and a constant image gives exactly 0. On a CPU they are done on some rows at a time, which stay in its
    cache from one operation to the next.
    """
    padded, height = _with_border(image, operator.reach), image.shape[-2]
    at_once = image.device.type != "cpu" or is_compiling()
    rows = height if at_once else max(1, _CACHED * height // image.numel())
    bands = (padded[..., top : min(top + rows, height) + 2 * operator.reach, :] for top in range(0, height, rows))
    return torch.cat([_norm([_correlated(band, stencil) for stencil in operator.stencils], p) for band in bands], -2)


def _correlated(padded: Tensor, stencil: Stencil) -> Tensor:
    """Correlate an image that has a border of the stencil's reach with it: [B, C, H, W]."""
    reach = len(stencil) // 2
    height, width = padded.shape[-2] - 2 * reach, padded.shape[-1] - 2 * reach
    weights: Dict[_Tap, float] = {
        (row - reach, column - reach): float(weight)
        for row, line in enumerate(stencil)
        for column, weight in enumerate(line)
        if weight and (row, column) != (reach, reach)
    }
    if _is_odd(weights, row_sign=-1):
        return _correlated(padded.transpose(-1, -2), tuple(zip(*stencil))).transpose(-1, -2)
    odd = _is_odd(weights, column_sign=-1)

    def rows(values: Tensor, row: int) -> Tensor:
        return values[..., reach + row : reach + row + height, :]

    def columns(column: int) -> Tensor:
        return padded[..., reach + column : reach + column + width]

    # Of an odd stencil, the right half of the taps: each stands for its difference from its mirror image.
    across = {
        column: columns(column) - columns(-column) if odd else columns(column)
        for _, column in weights
        if column > 0 or not odd
    }
    groups: Dict[float, List[Tensor]] = {}
    for row, column in sorted(weights, key=_from_the_centre):
        if column > 0 or not odd:
            groups.setdefault(weights[row, column], []).append(rows(across[column], row))
    centre = rows(columns(0), 0)
    parts = []
    for weight, values in groups.items():
        value = _sum(values) if odd else _sum(values) - float(len(values)) * centre
        parts.append(value if weight == 1.0 else weight * value)
    return _sum(parts)


_Tap = Tuple[int, int]  # row and column, from the centre


def _is_odd(weights: Mapping[_Tap, float], row_sign: int = 1, column_sign: int = 1) -> bool:
    return all(
        weights.get((row_sign * row, column_sign * column)) == -weight for (row, column), weight in weights.items()
    )


def _from_the_centre(tap: _Tap) -> Tuple[int, _Tap, _Tap]:
    """Order taps by their distance; opposite ones stand beside each other."""
    row, column = tap
    return row**2 + column**2, min(tap, (-row, -column)), tap


def _sum(values: Sequence[Tensor]) -> Tensor:
    """Add up in pairs: the sum of two, four or eight equal numbers is exact."""
    if len(values) == 1:
        return values[0]
    half = (len(values) + 1) // 2
    return _sum(values[:half]) + _sum(values[half:])


def _with_border(image: Tensor, reach: int) -> Tensor:
    """Reflect an image [B, C, H, W] at its sides; a side of one pixel continues itself."""
    if min(image.shape[-2:]) > reach:
        return F.pad(image, (reach,) * 4, mode="reflect")
    for axis in (-1, -2):
        size = image.shape[axis]
        period = max(2 * size - 2, 1)
        index = torch.arange(-reach, size + reach, device=image.device) % period
        image = image.index_select(axis, torch.minimum(index, period - index) % size)
    return image


def _norm(parts: List[Tensor], p: float) -> Tensor:
    if p == 1.0:
        return sum(part.abs().sum(1, keepdim=True) for part in parts)  # type: ignore[return-value]
    if p == 2.0:
        return torch.sqrt(sum((part * part).sum(1, keepdim=True) for part in parts))  # type: ignore[arg-type]
    return reduce(torch.maximum, [part.abs().amax(1, keepdim=True) for part in parts])
