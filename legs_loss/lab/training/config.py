"""The settings of a training run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Dict, List, Mapping, Optional

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.lab.training.dataset import TrainingView
from legs_loss.spec import PRESETS, Spec, WeightSpec, as_spec

# What a spec had not when the first comparisons were written: absent where it is the default, so that they go on.
ADDED_SETTINGS = ("over", "noise_floor", "smooth")
SWITCHES = ("shuffled", "sparse_adam")  # for the same reason absent where they are off, as are the next ones
WINDOW = ("weights_from", "weights_until")
COUNTS = (*WINDOW, "position_lr_max_steps", "max_gaussians")


@dataclass(frozen=True)
class TrainConfig:
    """The settings of a run; those that 3DGS has carry its names.

    Attributes:
        spec: of the weight maps: a preset's name or a WeightSpec.
        iterations: of one view each; the schedule scales with it (:class:`Schedule`).
        resolution: 3DGS's ``-r``: 1, 2, 4, 8, -1, or a width in pixels.
        sh_degree: of the colours, 0 to 3.
        lambda_dssim: the share of D-SSIM in the loss.
        l1_scale: multiplies the L1 term, weighted or not: for experiments.
        position_lr_max_steps: the iterations over which the learning rate of positions falls to its last value; None:
            all of them. 3DGS says 30000 whatever the run, so that positions keep moving to the end of a short one.
        densify_grad_threshold: a Gaussian whose mean view-space gradient reaches it is cloned or split. None chooses
            it by the size of the photographs, see :func:`default_threshold`.
        max_gaussians: a cap on their number, None for none.
        white_background: white in place of black.
        shuffled: each weight map's pixels in random order, the same weights displaced: for experiments.
        weights_from, weights_until: the weights count after the one iteration and to the other; outside of them the
            loss is plain. None: from the first, to the last. For experiments.
        sparse_adam: a step updates only the Gaussians that its view shows, which changes the results.
        seed: of the order of the views and of the places of split Gaussians.
    """

    spec: Spec = "legs"
    iterations: int = 2000
    resolution: int = -1
    sh_degree: int = 1
    lambda_dssim: float = 0.2
    l1_scale: float = 1.0
    position_lr_max_steps: Optional[int] = None
    densify_grad_threshold: Optional[float] = None
    max_gaussians: Optional[int] = None
    white_background: bool = False
    shuffled: bool = False
    weights_from: Optional[int] = None
    weights_until: Optional[int] = None
    sparse_adam: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "spec", as_spec(self.spec))
        threshold = self.densify_grad_threshold
        for name, fits, wanted in (
            ("iterations", 1 <= self.iterations < 1 << 31, "at least 1 and below 2^31"),
            ("sh_degree", self.sh_degree in (0, 1, 2, 3), "0, 1, 2 or 3"),
            ("lambda_dssim", 0.0 <= self.lambda_dssim <= 1.0, "in [0, 1]"),
            ("l1_scale", 0.0 <= self.l1_scale < float("inf"), "at least 0"),
            ("densify_grad_threshold", threshold is None or threshold > 0.0, "above 0"),
            *((name, type(getattr(self, name)) is bool, "True or False") for name in SWITCHES),
            *((name, getattr(self, name) is None or getattr(self, name) >= 1, "at least 1") for name in COUNTS),
            ("seed", -(1 << 63) <= self.seed < 1 << 63, "an integer of 64 bits"),
        ):
            if not fits:
                raise LegsError(f"{name} must be {wanted}, got {getattr(self, name)!r}")

    def as_dict(self) -> Dict[str, Any]:
        """Return the settings as JSON holds them."""
        values = asdict(self)
        values["spec"]["p"] = str(self.weights.p)  # JSON has no infinity
        for name in ADDED_SETTINGS:
            if values["spec"][name] == getattr(PRESETS["legs"], name):
                del values["spec"][name]
        for name in SWITCHES + WINDOW:
            if not values[name]:
                del values[name]
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Return the settings that :meth:`as_dict` gave; ``spec`` may also be a preset's name.

        Raises:
            LegsError: they are invalid.
        """
        try:
            spec = values["spec"]
            if not isinstance(spec, str):
                spec = WeightSpec(**dict(spec, p=float(spec["p"])))
            return cls(**dict(values, spec=spec))
        except LegsError:
            raise
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LegsError(f"these are not settings of a training: {error}") from None

    @property
    def weights(self) -> WeightSpec:
        """Return ``spec``, resolved."""
        return as_spec(self.spec)

    def weighted(self, iteration: int) -> bool:
        """Return whether the weights count in an iteration."""
        return (self.weights_from or 0) < iteration <= (self.weights_until or iteration)

    @property
    def background(self) -> Tensor:
        """Return the colour behind all Gaussians, [3]."""
        return torch.full((3,), 1.0 if self.white_background else 0.0)


def default_threshold(views: List[TrainingView]) -> float:
    """Return the densification threshold for photographs of this size: 0.12 / sqrt(width * height), at least 2e-4.

    3DGS's own 2e-4 is for photographs more than 1000 pixels wide. Its gradients are per half image, so that the
    gradient of a Gaussian that covers a given number of pixels grows as the image shrinks, and 2e-4 makes several
    times as many Gaussians as a small image has use for. The rule gives 5e-4 at 180x320, and 2e-4 from 600x600 on.
    """
    pixels = sum(view.image[0].numel() for view in views) / len(views)
    return max(2e-4, 0.12 / math.sqrt(pixels))
