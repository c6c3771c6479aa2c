"""One call of `l1_loss`: its arguments, checked once, and its loss with and without a weight."""

from __future__ import annotations

from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Union

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import Layout, is_trained, read_pair
from legs_loss.kernels.backends import fused_l1
from legs_loss.loss import mean_error
from legs_loss.weights import Weights

__all__ = ["Call", "Own", "View"]

View = Union[str, int, Sequence[Union[str, int]], None]
Own = Callable[[Tensor, Tensor], Tensor]


class Call(NamedTuple):
    """The arguments of :func:`~legs_loss.l1_loss`.

    Attributes:
        layout: of the images as they were given; None until :meth:`aligned` has made them [C, H, W] or [B, C, H, W].
    """

    prediction: Tensor
    target: Tensor
    view: View
    mask: Optional[Tensor]
    channels_last: Optional[bool]
    reduction: str
    own: Optional[Own]
    layout: Optional[Layout] = None

    def check_options(self) -> None:
        """Check the options; the images' shapes are checked by :meth:`aligned`, when they need a weight.

        Raises:
            LegsError: an image that is no tensor, an unknown reduction, or options that exclude one another.
        """
        if not (isinstance(self.prediction, Tensor) and isinstance(self.target, Tensor)):
            read_pair(self.prediction, self.target)  # the error names which
        if self.reduction not in ("mean", "none"):
            raise LegsError(f'reduction must be "mean" or "none", got {self.reduction!r}')
        if self.own is not None and (self.mask is not None or self.reduction != "mean"):
            raise LegsError("own= replaces mask= and reduction=: what it returns is returned")

    def trains(self) -> bool:
        """Return whether the prediction is being trained on: evaluation code is not weighted."""
        return is_trained(self.prediction)

    def aligned(self) -> Call:
        """Return the call with images [C, H, W] or [B, C, H, W], checked, as a weight needs them.

        Raises:
            LegsError: shapes or devices that do not fit, or a layout that contradicts ``channels_last``.
        """
        layout, prediction, target = read_pair(self.prediction, self.target, self.channels_last)
        images = layout.channels_first(prediction), layout.channels_first(target)
        mask = layout.map_first(self.mask, target, "mask")
        return Call(*images, self.view, mask, self.channels_last, self.reduction, self.own, layout)

    def view_names(self) -> List[Optional[str]]:
        """Return the name of each image's view, None for an image without one.

        Raises:
            LegsError: another number of names than of images, or a name that is no text or number.
        """
        batch = self.target.shape[0] if self.target.dim() == 4 else 1
        if self.view is None:
            return [None] * batch
        names: List[Any] = list(self.view) if isinstance(self.view, (list, tuple)) else [self.view]
        if len(names) != batch or not all(isinstance(name, (str, int)) for name in names):
            raise LegsError(
                f"view must be one name a view: target {list(self.target.shape)} holds {batch}, got {self.view!r}"
            )
        return [str(name) for name in names]

    def is_mean(self) -> bool:
        """Return whether only the mean is requested: a backend needs no weight map in memory for it."""
        return self.own is None and self.reduction == "mean"

    def plain(self) -> Tensor:
        """Return the codebase's own loss."""
        if self.own is not None:
            return self.own(self.prediction, self.target)
        if self.is_mean() and self.mask is None:
            error = torch.abs(self.prediction - self.target)
            if not error.is_floating_point():
                raise LegsError(f"both images are of type {error.dtype}: give floats in [0, 1] (8-bit: image / 255.0)")
            return error.mean()
        call = self.aligned()
        return call._of(Weights().masked(call.mask, renormalise=False))

    def weighted(self, weights: Weights) -> Tensor:
        """Return the loss with these weights."""
        weights = weights.masked(self.mask, renormalise=False)
        if self.is_mean():
            loss = fused_l1(self.prediction, self.target, weights)
            if loss is not None:
                return loss
        with torch.no_grad():
            weights = weights.with_map(self.target)
        return self._of(weights)

    def _of(self, weights: Weights) -> Tensor:
        assert self.layout is not None
        if self.is_mean():
            return mean_error(self.prediction, self.target, weights)
        weight, error = weights.map, self.prediction - self.target
        if weight is not None:  # where a reduction of the codebase follows, its mean becomes the mean over what counts
            error = weights.of_what_counts(weight).to(error.dtype) * error
        if self.own is None:
            return self.layout.restored(torch.abs(error))
        if weight is None:
            return self.own(self.layout.restored(self.prediction), self.layout.restored(self.target))
        # |F + W * (U - F) - F| = W * |U - F|: any L1 of the difference becomes the weighted one, and masks that the
        # codebase makes from the target stay as they are.
        return self.own(self.layout.restored(self.target + error), self.layout.restored(self.target))
