"""The operators of a response, by name: their stencils, without the border and the norm.

Like the curves they want nothing but a tensor's own methods, so that a setting is checked without importing torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Callable, Dict, List, Tuple

from legs_loss.errors import LegsError

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["NORMS", "OPERATORS", "check_operator", "operator_names"]

# An operator takes the image with a border of one pixel, [B, C, H+2, W+2], and returns its components,
# each [B, C, H, W]. Differences are taken in an order that is exactly zero on a constant image.
Operator = Callable[["Tensor"], List["Tensor"]]


def _neighbour(padded: Tensor, row: int, column: int) -> Tensor:
    height, width = padded.shape[-2] - 2, padded.shape[-1] - 2
    return padded[..., 1 + row : 1 + row + height, 1 + column : 1 + column + width]


def _cross(padded: Tensor) -> Tensor:
    return (_neighbour(padded, -1, 0) + _neighbour(padded, 1, 0)) + (
        _neighbour(padded, 0, -1) + _neighbour(padded, 0, 1)
    )


def _laplacian(padded: Tensor) -> List[Tensor]:
    return [_cross(padded) - 4.0 * _neighbour(padded, 0, 0)]


def _laplacian8(padded: Tensor) -> List[Tensor]:
    diagonal = (_neighbour(padded, -1, -1) + _neighbour(padded, 1, 1)) + (
        _neighbour(padded, -1, 1) + _neighbour(padded, 1, -1)
    )
    return [(_cross(padded) + diagonal) - 8.0 * _neighbour(padded, 0, 0)]


def _central(padded: Tensor) -> List[Tensor]:
    return [
        0.5 * (_neighbour(padded, 0, 1) - _neighbour(padded, 0, -1)),
        0.5 * (_neighbour(padded, 1, 0) - _neighbour(padded, -1, 0)),
    ]


def _smoothed_difference(side: float, middle: float) -> Operator:
    def operator(padded: Tensor) -> List[Tensor]:
        across = padded[..., :, 2:] - padded[..., :, :-2]
        down = padded[..., 2:, :] - padded[..., :-2, :]
        return [
            side * (across[..., :-2, :] + across[..., 2:, :]) + middle * across[..., 1:-1, :],
            side * (down[..., :, :-2] + down[..., :, 2:]) + middle * down[..., :, 1:-1],
        ]

    return operator


OPERATORS: Dict[str, Operator] = {
    "laplacian": _laplacian,
    "laplacian8": _laplacian8,
    "sobel": _smoothed_difference(1.0, 2.0),
    "scharr": _smoothed_difference(3.0, 10.0),
    "central": _central,
}

NORMS = (1.0, 2.0, float("inf"))


def operator_names() -> Tuple[str, ...]:
    """Return the names that ``operator`` may take."""
    return tuple(OPERATORS)


def check_operator(operator: str, p: float) -> None:
    """Check the two settings of a response.

    Raises:
        LegsError: one of them is unknown; the message lists what there is.
    """
    if operator not in OPERATORS:
        raise LegsError(f"no operator is named {operator!r}: choose one of {', '.join(OPERATORS)}")
    if p not in NORMS:
        raise LegsError(f"p must be 1, 2 or inf, got {p!r}")
