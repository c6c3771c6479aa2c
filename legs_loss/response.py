"""The response of a photograph to a second- or first-order operator: where its contours and thin structures are.

    E = || op F ||_p        normalised per image: E^ = (E - min E) / (max E - min E + eps)

Source: the LEGS paper, its weight's definition (op = Laplacian); EGGS, arXiv 2404.09105 (op = gradient).
"""

from __future__ import annotations

from typing import List

import torch
import torch.nn.functional as F
from torch import Tensor

from legs_loss.images import channels_first, check_image
from legs_loss.operators import OPERATORS, check_operator

__all__ = ["normalise_response", "response"]


def response(image: Tensor, operator: str = "laplacian", p: float = 2.0, channels_last: bool = False) -> Tensor:
    """Return the response E = || op F ||_p of an image, one value a pixel.

    Args:
        image: floats, [C, H, W] or [B, C, H, W] with any number of channels; [H, W, C] or [B, H, W, C] with
            ``channels_last``. Half precision is computed in float32.
        operator: "laplacian" (4 neighbours: 0 1 0 / 1 -4 1 / 0 1 0), "laplacian8" (1 1 1 / 1 -8 1 / 1 1 1), or
            a gradient: "sobel" (1 2 1), "scharr" (3 10 3), both unscaled, or "central" (differences / 2).
        p: 1, 2 or inf: the norm over channels, and for a gradient over its two directions too.
        channels_last: where the channel stands.

    Returns:
        The image's shape with one channel, values >= 0, float32 (float64 for float64). The border is reflected
        (the edge pixel is not repeated), so the frame of the picture is no edge. No gradient flows to the image.

    Raises:
        LegsError: not an image, or an unknown operator or norm.

    Example:
        >>> dot = torch.zeros(1, 3, 3)
        >>> dot[0, 1, 1] = 1.0
        >>> response(dot)
        tensor([[[0., 2., 0.],
                 [2., 4., 2.],
                 [0., 2., 0.]]])
    """
    check_image(image)
    check_operator(operator, p)
    flat = channels_first(image.detach(), channels_last)
    flat = flat.to(torch.promote_types(flat.dtype, torch.float32))
    single = flat.dim() == 3
    parts = OPERATORS[operator](_with_border(flat.unsqueeze(0) if single else flat))
    strength = _norm(parts, p)
    strength = strength[0] if single else strength
    return strength.movedim(-3, -1) if channels_last else strength


def normalise_response(response: Tensor, eps: float = 1e-8) -> Tensor:
    """Return E^ = (E - min E) / (max E - min E + eps), each image of a batch by itself.

    Args:
        response: [1, H, W] or [B, 1, H, W], or channels-last, as :func:`response` returns it.
        eps: keeps a constant response at 0.

    Returns:
        The same shape, in [0, 1]. A NaN in an image makes all of its map NaN: it is never hidden.

    Example:
        >>> normalise_response(torch.tensor([[[1.0, 2.0, 5.0]]]))
        tensor([[[0.0000, 0.2500, 1.0000]]])
    """
    over = tuple(range(response.dim() - 3, response.dim()))
    low = response.amin(over, keepdim=True)
    high = response.amax(over, keepdim=True)
    return (response - low) / (high - low + eps)


def _with_border(image: Tensor) -> Tensor:
    # A side of one pixel has nothing to reflect: its only continuation is itself.
    image = F.pad(image, (1, 1, 0, 0), mode="reflect" if image.shape[-1] > 1 else "replicate")
    return F.pad(image, (0, 0, 1, 1), mode="reflect" if image.shape[-2] > 1 else "replicate")


def _norm(parts: List[Tensor], p: float) -> Tensor:
    if p == 1.0:
        return sum(part.abs().sum(1, keepdim=True) for part in parts)  # type: ignore[return-value]
    if p == 2.0:
        return torch.sqrt(sum((part * part).sum(1, keepdim=True) for part in parts))  # type: ignore[arg-type]
    peaks = [part.abs().amax(1, keepdim=True) for part in parts]
    return peaks[0] if len(peaks) == 1 else torch.maximum(peaks[0], peaks[1])
