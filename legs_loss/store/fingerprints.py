"""Identify the training image that a map was made from."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from typing import Tuple, Union

import numpy as np
import torch
from torch import Tensor

_SAMPLES = 4096  # pixels; what changes a thousandth of an image meets one, but for 2 in 100 such changes


def fingerprint(image: Union[Tensor, np.ndarray]) -> str:
    """Return a hash of an image's values: images with different maps have different hashes.

    Values that are multiples of 1/255, as in 8-bit photographs, are hashed as integers, independent of their rounding;
    multiples of 1/65535 likewise; an image with any other value is hashed by its float32 values, to the last bit.

    Args:
        image: floats in [0, 1], [C, H, W], on any device; or uint8 or uint16 [H, W, C].

    Examples:
        >>> pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
        >>> fingerprint(pixels) == fingerprint(torch.from_numpy(pixels).permute(2, 0, 1) / 255.0)
        True
    """
    return _digest(image, sampled=False)


def sampled_fingerprint(image: Union[Tensor, np.ndarray]) -> str:
    """Return a hash of an image's size and of some thousand of its values, at places that depend on the size alone.

    On a device the values are gathered there, and one short copy waits for it: for where :func:`fingerprint` would move
    the whole image. Arguments as there.

    Examples:
        >>> pixels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
        >>> sampled_fingerprint(pixels) == sampled_fingerprint(torch.from_numpy(pixels).permute(2, 0, 1) / 255.0)
        True
    """
    return _digest(image, sampled=True)


@lru_cache(maxsize=64)
def _places(height: int, width: int, device: torch.device) -> Tuple[Tensor, Tensor]:
    """Return rows and columns that lie evenly over an image, and on no grid: of multiples of the golden ratio."""
    pixels = ((torch.arange(_SAMPLES) * 2654435769 % 2**32) * (height * width)) >> 32
    return (pixels // width).to(device), (pixels % width).to(device)


def _digest(image: Union[Tensor, np.ndarray], sampled: bool) -> str:
    if isinstance(image, np.ndarray) and image.dtype in (np.uint8, np.uint16):
        rows, columns = _places(*image.shape[:2], torch.device("cpu"))
        values, shape = image[rows.numpy(), columns.numpy()] if sampled else image, image.shape
    else:
        tensor = torch.as_tensor(image).detach().resolve_neg()
        shape = (*tensor.shape[1:], tensor.shape[0])
        rows, columns = _places(*shape[:2], tensor.device)
        taken = tensor[:, rows, columns] if sampled else tensor.flatten(1)
        values = _whole_numbers(taken.float().cpu().numpy().T, tensor.dtype == torch.float16)
    if values.dtype == np.uint16 and not (values % 257).any():
        values = (values // 257).astype(np.uint8)  # an 8-bit photograph in 16 bits
    kind = "" if values.dtype == np.uint8 else values.dtype.name
    digest = hashlib.sha256(f"{tuple(shape)!r}{kind}".encode())
    digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()[:32]


def _whole_numbers(image: np.ndarray, halves: bool) -> np.ndarray:
    """Return an image's values as the 8- or 16-bit numbers that they are fractions of; else as they are."""
    # float32 rounds values up to 1 by 6e-8, float16 by 2^-12.
    for kind, tolerance in ((np.uint8, 255 / 4096 if halves else 1e-4), (np.uint16, 2e-2)):
        scaled = image * np.float32(np.iinfo(kind).max)
        whole = np.rint(scaled)
        with np.errstate(invalid="ignore"):  # of an infinity
            near = np.abs(scaled - whole).max() <= tolerance
        if near and whole.min() >= 0 and whole.max() <= np.iinfo(kind).max:
            return whole.astype(kind)
    return image
