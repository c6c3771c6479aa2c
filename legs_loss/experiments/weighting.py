"""Weights for experiments: maps that a spec cannot describe, and weights that change during a run.

Each function takes a run's training views and its settings, and returns what gives each iteration its weight map; see
:data:`legs_loss.reference.training.trainer.Weighting`.
"""

from __future__ import annotations

from typing import List, Mapping, Optional

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from legs_loss.reference.training.dataset import TrainingView
from legs_loss.reference.training.trainer import TrainConfig, Weigh, Weighting, by_error
from legs_loss.response import normalise_response, response
from legs_loss.spec import WeightSpec
from legs_loss.weights import weight_from_response

__all__ = ["WEIGHTINGS"]

SCALES = (1, 2, 4)  # the photograph's own size, a half and a quarter of it


def shuffled(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Return each map's pixels in random order, different for each view and seed: the same weights, displaced."""
    generator = torch.Generator().manual_seed(1_000_003 + config.seed)
    maps = [_shuffle(view.weight, generator) for view in views]
    return lambda index, done, rendering: maps[index]


def growing(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Beta grows from 0 to the spec's over the run."""
    return lambda index, done, rendering: _faded(views[index].weight, done)


def fading(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Beta falls from the spec's to 0 over the run."""
    return lambda index, done, rendering: _faded(views[index].weight, 1.0 - done)


def multiscale(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Return the mean of the normalised responses at three sizes of the photograph, not the one at its own."""
    spec = config.weights
    means = [torch.stack([_response_at(view.image, scale, spec) for scale in SCALES]).mean(0) for view in views]
    maps = [weight_from_response(mean, spec) for mean in means]
    return lambda index, done, rendering: maps[index]


def late(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Return the spec's weights from a third of the run on; 3DGS's own loss before."""
    return _from(1.0 / 3.0, views, config)


def latest(views: List[TrainingView], config: TrainConfig) -> Weigh:
    """Return the spec's weights from two thirds of the run on; 3DGS's own loss before."""
    return _from(2.0 / 3.0, views, config)


WEIGHTINGS: Mapping[str, Weighting] = {
    "shuffled": shuffled,
    "growing": growing,
    "fading": fading,
    "multiscale": multiscale,
    "late": late,
    "latest": latest,
}


def _from(onset: float, views: List[TrainingView], config: TrainConfig) -> Weigh:
    def maps(index: int, done: float, rendering: Tensor) -> Optional[Tensor]:
        return views[index].weight

    weigh = by_error(views, config) if config.weights.error > 0.0 else maps
    return lambda index, done, rendering: weigh(index, done, rendering) if done > onset else None


def _shuffle(weight: Optional[Tensor], generator: torch.Generator) -> Optional[Tensor]:
    if weight is None:
        return None
    return weight.flatten()[torch.randperm(weight.numel(), generator=generator)].reshape(weight.shape)


def _faded(weight: Optional[Tensor], share: float) -> Optional[Tensor]:
    """1 + share * (W - 1): for unnormalised maps that is the map of ``share`` times beta; the mean 1 stays."""
    return None if weight is None else 1.0 + share * (weight - 1.0)


def _response_at(image: Tensor, scale: int, spec: WeightSpec) -> Tensor:
    height, width = image.shape[1:]
    smaller = avg_pool2d(image, scale, ceil_mode=True, count_include_pad=False) if scale > 1 else image
    normalised = normalise_response(response(smaller, spec.operator, spec.p, smooth=spec.smooth), spec.eps)
    if scale == 1:
        return normalised
    return interpolate(normalised[None], size=(height, width), mode="bilinear", align_corners=False)[0]
