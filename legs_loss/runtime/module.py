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
from legs_loss.loss import legs_loss
from legs_loss.runtime.call import Call
from legs_loss.runtime.state import Run
from legs_loss.spec import Spec, WeightSpec, as_spec
from legs_loss.weights import weight_map

__all__ = ["LEGSLoss"]


class LEGSLoss(nn.Module):
    """:func:`~legs_loss.legs_loss` as a Module: settings at construction, images at each call.

    A spec that is normalised over the scene needs the store that has its levels.

    Args:
        spec: as for :func:`~legs_loss.legs_loss`, like the others.
        lambda_dssim: the share of D-SSIM.
        padding: of SSIM.
        renormalise: divide the masked L1 term by the mask's mean.
        channels_last: where the channel stands, for shapes that do not show it.
        store: a folder that ``legs precompute`` wrote: its maps are used for exactly the images that they belong to.
            With masks in it the L1 is the mean over what counts, SSIM sees no difference where it is 0, and an image
            that is not found is said, or with LEGS_MASKS=require an error (docs/masks.md).

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
        prediction, target, mask, renormalise = call.prediction, call.target, call.mask, self.renormalise
        with torch.no_grad():
            found = run.source.weights(call)
            weight = found.map
            if found.spec is not None and (weight is not None or found.mask is not None):
                made = weight_map(target, self.spec, False)
                weight = made if weight is None else made * weight
        if found.mask is not None:
            if mask is not None:  # the call's own is not renormalised: a factor of the weight
                weight = mask.float() if weight is None else weight * mask
            mask, renormalise = found.mask, True
            counted.hidden += 1
            prediction = torch.where(mask == 0, target.to(prediction.dtype), prediction)
        run.say_what_is_used()
        return legs_loss(
            prediction, target, self.spec, weight, mask, self.lambda_dssim, self.padding, renormalise, False
        )

    def extra_repr(self) -> str:
        """Return the settings, for ``print(module)``."""
        return f"{self.spec}, lambda_dssim={self.lambda_dssim}, padding={self.padding!r}"
