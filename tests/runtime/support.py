"""Images, and the plain and the weighted loss by the formula."""

from __future__ import annotations

import torch

from legs_loss import weight_map


def pair(*shape):
    return torch.rand(shape, requires_grad=True), torch.rand(shape)


def plain(prediction, target):
    return torch.abs(prediction - target).mean()


def weighted(prediction, target, spec="legs"):
    return (weight_map(target, spec) * torch.abs(prediction - target)).mean()
