"""Pairs of images, and a loss of the next pair at each call."""

from __future__ import annotations

import itertools
from typing import Callable, Sequence, Tuple

import torch
from torch import Tensor

__all__ = ["PAIRS", "Pairs", "images", "in_turns", "some_images"]

PAIRS = 8  # of images that take turns: one alone would stay in a GPU's cache, which no training's does
Pairs = Sequence[Tuple[Tensor, Tensor]]


def images(size: Tuple[int, int], device: torch.device) -> Tuple[Tensor, Tensor]:
    """Return a prediction that learns and a target: a picture of waves with noise, 8 bits deep as photographs are."""
    width, height = size
    generator = torch.Generator().manual_seed(0)
    x, y = torch.arange(float(width)) / 37.0, torch.arange(float(height))[:, None] / 23.0
    waves = torch.stack([0.5 + 0.3 * torch.sin((k + 1) * x + torch.cos(y * (k + 1))) for k in range(3)])
    target = (waves + 0.05 * torch.randn(3, height, width, generator=generator)).clamp(0.0, 1.0)
    target = (255.0 * target).round() / 255.0
    prediction = 0.9 * target + 0.05 * torch.rand(3, height, width, generator=generator)
    return prediction.to(device).requires_grad_(), target.to(device)


def some_images(size: Tuple[int, int], device: torch.device) -> Pairs:
    """Return pairs of images that differ."""
    prediction, target = images(size, device)
    return [(prediction.detach().roll(31 * i, -1).requires_grad_(), target.roll(31 * i, -1)) for i in range(PAIRS)]


def in_turns(pairs: Pairs, loss: Callable[[Tensor, Tensor, int], Tensor]) -> Callable[[], None]:
    """Return a function that computes a loss and its gradient, each time of the next pair, which is the i-th."""
    turn = itertools.cycle(range(len(pairs)))

    def run() -> None:
        i = next(turn)
        image, target = pairs[i]
        image.grad = None
        loss(image, target, i).backward()

    return run
