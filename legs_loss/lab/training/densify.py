"""3DGS's adaptive density control: clone, split and prune."""

from __future__ import annotations

from typing import NamedTuple, Optional

import torch
from torch import Tensor

from legs_loss.lab.gaussians import Gaussians, rotations
from legs_loss.lab.training.adam import select, stack

PERCENT_DENSE = 0.01  # of the extent: a wider Gaussian is split, another one cloned
CHILDREN = 2  # of a split; their scales are the parent's over 0.8 * CHILDREN
MIN_OPACITY = 0.005
MAX_SCALE = 0.1  # of the extent: a wider Gaussian is pruned once opacities have been reset
RESET_OPACITY = 0.01


class Schedule(NamedTuple):
    """The schedule of a training, in iterations."""

    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int
    sh_every: int

    @classmethod
    def of_run(cls, iterations: int) -> Schedule:
        """Return 3DGS's schedule, for runs of any length.

        Densification begins after a tenth of the run, at iteration 500 at the latest, ends after three fifths of it,
        at iteration 15000 at the latest, and is due every 100 iterations or every twentieth of a shorter run.
        Opacities are reset every tenth of the run but not before iteration 3000, and only while densifying: a run of
        5000 iterations or less has no time to recover from a reset.

        >>> Schedule.of_run(30000)
        Schedule(densify_from=500, densify_until=15000, densify_every=100, reset_every=3000, sh_every=1000)
        >>> Schedule.of_run(1000)
        Schedule(densify_from=100, densify_until=600, densify_every=50, reset_every=3000, sh_every=33)
        """
        return cls(
            densify_from=min(500, iterations // 10),
            densify_until=min(15000, iterations * 3 // 5),
            densify_every=min(100, max(1, iterations // 20)),
            reset_every=max(3000, iterations // 10),
            sh_every=max(1, iterations // 30),
        )

    def densifies(self, iteration: int) -> bool:
        """Return whether this iteration, counted from 1, ends with a densification."""
        return self.densify_from < iteration < self.densify_until and iteration % self.densify_every == 0

    def resets(self, iteration: int) -> bool:
        """Return whether this iteration ends with an opacity reset."""
        return iteration < self.densify_until and iteration % self.reset_every == 0


class Change(NamedTuple):
    """The change of a set by a densification: which Gaussians stay (indices), and which are appended."""

    kept: Tensor
    new: Gaussians


def densify(
    gaussians: Gaussians,
    gradient: Tensor,
    threshold: float,
    extent: float,
    generator: torch.Generator,
    max_gaussians: Optional[int] = None,
) -> Change:
    """Clone the small and split the large of the Gaussians whose gradient reaches the threshold.

    Args:
        gaussians: the set.
        gradient: [N], the mean length of the view-space gradient over the renderings that showed the Gaussian, in
            3DGS's units (pixels times half the image size).
        threshold: 3DGS's densify_grad_threshold.
        extent: 3DGS's cameras_extent: 1.1 times the radius of the camera centres about their mean.
        generator: where the children of a split are placed.
        max_gaussians: a cap: where more would be made, those with the largest gradients are.
    """
    chosen = gradient >= threshold
    if max_gaussians is not None:
        room = max(0, max_gaussians - len(gaussians))  # a clone and a split each add one Gaussian
        if int(chosen.sum()) > room:
            ranked = torch.sort(gradient, descending=True, stable=True).indices[:room]
            allowed = torch.zeros_like(chosen)
            allowed[ranked] = True
            chosen &= allowed
    large = gaussians.scales.detach().amax(1) > PERCENT_DENSE * extent
    clones = select(gaussians, chosen & ~large)
    children = _split(select(gaussians, chosen & large), generator)
    return Change(torch.nonzero(~(chosen & large))[:, 0], stack(clones, children))


def _split(parents: Gaussians, generator: torch.Generator) -> Gaussians:
    """Return each parent's children, drawn from the parent's own distribution."""
    many = select(parents, torch.arange(len(parents)).repeat(CHILDREN))
    offsets = torch.randn(len(many), 3, generator=generator) * many.scales
    rotated = (rotations(many.quaternions) @ offsets[:, :, None])[:, :, 0]
    shrink = torch.log(torch.tensor(0.8 * CHILDREN))
    return Gaussians(many.means + rotated, many.log_scales - shrink, many.quaternions, many.opacity_logits, many.sh)


def prunable(gaussians: Gaussians, extent: float, large_too: bool) -> Tensor:
    """Return which Gaussians, bool [N], are all but transparent or (``large_too``) wider than a tenth of the extent.

    3DGS also intends to prune Gaussians larger than 20 pixels on a screen; its code resets the radii just before that
    test, so that it never does, and neither does this.
    """
    transparent = gaussians.opacities.detach()[:, 0] < MIN_OPACITY
    if not large_too:
        return transparent
    return transparent | (gaussians.scales.detach().amax(1) > MAX_SCALE * extent)
