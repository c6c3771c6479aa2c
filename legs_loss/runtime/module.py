"""The whole loss as a Module, with the maps of a store if it is given one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Optional, Union

import torch
from torch import Tensor, nn

from legs_loss.config import find_config
from legs_loss.counting import counted
from legs_loss.images import check_order
from legs_loss.loss import legs_loss, total_loss
from legs_loss.runtime.call import Call
from legs_loss.runtime.state import Run
from legs_loss.spec import Spec, WeightSpec, as_spec

__all__ = ["LEGSLoss"]


class LEGSLoss(nn.Module):
    """:func:`~legs_loss.legs_loss` as a Module: settings at construction, images at each call.

    A spec that is normalised over the scene needs the store that has its levels.

    Args:
        spec: as for :func:`~legs_loss.legs_loss`, like the others.
        lambda_dssim: the share of D-SSIM.
        padding: of SSIM.
        renormalise: make both terms the mean over what a ``mask`` counts.
        channels_last: where the channel stands, for shapes that do not show it.
        store: a folder that ``legs precompute`` wrote: its maps are used for exactly the images that they belong to.
            With masks in it both terms are the mean over what counts, and an image that is not found is said, or with
            LEGS_MASKS=require an error (docs/masks.md).

    Shape:
        prediction, target: [H, W], [C, H, W], [H, W, C] or batches; weight, mask: one value a pixel; output: a scalar.

    Examples:
        >>> criterion = LEGSLoss("legs-l")
        >>> target = torch.rand(3, 16, 16)
        >>> criterion(target, target) < 1e-6
        tensor(True)
    """

    def __init__(
        self,
        spec: Spec = "legs",
        lambda_dssim: float = 0.2,
        padding: str = "zeros",
        renormalise: bool = False,
        channels_last: Optional[bool] = None,
        store: Union[str, Path, None] = None,
    ) -> None:
        super().__init__()
        self.spec: WeightSpec = as_spec(spec)
        self.lambda_dssim = lambda_dssim
        self.padding = padding
        self.renormalise = renormalise
        self.channels_last = channels_last
        self._run: Optional[Run] = None
        if store is not None:
            config = find_config(None, argv=[])
            self._run = Run(replace(config, spec=self.spec, preset="LEGSLoss", store=Path(store), source="LEGSLoss()"))

    def forward(
        self,
        prediction: Tensor,
        target: Tensor,
        weight: Optional[Tensor] = None,
        mask: Optional[Tensor] = None,
    ) -> Tensor:
        """Return the loss; see :func:`~legs_loss.legs_loss`."""
        if self._run is not None and weight is None:
            return self._by_store(self._run, prediction, target, mask)
        return legs_loss(
            prediction,
            target,
            self.spec,
            weight,
            mask,
            self.lambda_dssim,
            self.padding,
            self.renormalise,
            self.channels_last,
        )

    def _by_store(self, run: Run, prediction: Tensor, target: Tensor, mask: Optional[Tensor]) -> Tensor:
        call = Call(prediction, target, None, mask, self.channels_last, "mean", None).aligned()
        check_order(call.prediction, call.target)
        with torch.no_grad():
            weights = run.source.weights(call)
            counted.hidden += weights.share is not None
            weights = weights.masked(call.mask, self.renormalise and weights.share is None)
        run.say_what_is_used()
        made = "" if weights.map is None and self.spec.unweighted else "by LEGSLoss"
        return total_loss(call.prediction, call.target, weights, self.lambda_dssim, self.padding, made)

    def extra_repr(self) -> str:
        """Return the settings, for ``print(module)``."""
        return f"{self.spec}, lambda_dssim={self.lambda_dssim}, padding={self.padding!r}"
