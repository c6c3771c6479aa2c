"""One call of `l1_loss`: its arguments, checked once, and its loss with and without a weight."""

from __future__ import annotations

from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Union

import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.images import as_map, check_pair
from legs_loss.kernels.backends import fused_l1
from legs_loss.kernels.contract import Weights
from legs_loss.loss import weighted_l1
from legs_loss.weights import weight_map

__all__ = ["Call", "Own", "View"]

View = Union[str, int, Sequence[Union[str, int]], None]
Own = Callable[[Tensor, Tensor], Tensor]


class Call(NamedTuple):
    """The arguments of :func:`~legs_loss.l1_loss`.

    Attributes:
        shape: of the images as they were given, where :meth:`aligned` has folded the axes before their last three.
    """

    prediction: Tensor
    target: Tensor
    view: View
    mask: Optional[Tensor]
    channels_last: bool
    reduction: str
    own: Optional[Own]
    shape: Optional[Sequence[int]] = None

    def check_options(self) -> None:
        """Check the options; the images are checked by :meth:`aligned`, when they need a weight.

        Raises:
            LegsError: an unknown reduction, or options that exclude one another.
        """
        if self.reduction not in ("mean", "none"):
            raise LegsError(f'reduction must be "mean" or "none", got {self.reduction!r}')
        if self.own is not None and (self.mask is not None or self.reduction != "mean"):
            raise LegsError("own= replaces mask= and reduction=: what it returns is returned")

    def trains(self) -> bool:
        """Return whether the prediction is being trained on: evaluation code is not weighted."""
        return self.prediction.requires_grad and torch.is_grad_enabled()

    def aligned(self) -> Call:
        """Return the call with a pair of images or of batches, checked, as a weight needs them.

        Axes in front of a batch's are folded into it; beside a batch of one image, an image is a batch of one.

        Raises:
            LegsError: shapes or devices that do not fit, or a layout that contradicts ``channels_last``.
        """
        call = self
        if isinstance(self.target, Tensor) and isinstance(self.prediction, Tensor):
            prediction, target = self.prediction, self.target
            if target.dim() > 4 and prediction.shape == target.shape:
                call = self._folded()
            elif target.shape == (1, *prediction.shape):
                call = self._replace(prediction=prediction.unsqueeze(0))
            elif prediction.shape == (1, *target.shape):
                call = self._replace(target=target.unsqueeze(0))
        check_pair(call.prediction, call.target)
        _check_layout(call.target, call.channels_last)
        return call

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
            return torch.abs(self.prediction - self.target).mean()
        return self._with_map(None)

    def weighted(self, weights: Weights) -> Tensor:
        """Return the loss with these weights."""
        if self.is_mean():
            loss = fused_l1(self.prediction, self.target, weights._replace(mask=self.mask), self.channels_last)
            if loss is not None:
                return loss
        if weights.spec is None:
            return self._with_map(weights.map)
        with torch.no_grad():
            weight = weight_map(self.target, weights.spec, self.channels_last)
        return self._with_map(weight)

    def _with_map(self, weight: Optional[Tensor]) -> Tensor:
        if self.own is not None:
            assert weight is not None
            # |F + W * (U - F) - F| = W * |U - F|: any L1 of the difference becomes the weighted one, and masks that the
            # codebase makes from the target stay as they are.
            weight = as_map(weight, self.prediction, self.channels_last, "weight").to(self.prediction.dtype)
            moved = self.target + weight * (self.prediction - self.target)
            return self.own(self._unfolded(moved), self._unfolded(self.target))
        if self.reduction == "mean":
            return weighted_l1(self.prediction, self.target, weight, self.mask, channels_last=self.channels_last)
        error = torch.abs(self.prediction - self.target)
        for factor, name in ((weight, "weight"), (self.mask, "mask")):
            if factor is not None:
                error = as_map(factor, self.prediction, self.channels_last, name).to(error.dtype) * error
        return self._unfolded(error)

    def _folded(self) -> Call:
        shape = self.target.shape

        def folded(tensor: Tensor) -> Tensor:
            return tensor.reshape(-1, *tensor.shape[len(shape) - 3 :])

        mask = None if self.mask is None else folded(self.mask)
        return self._replace(prediction=folded(self.prediction), target=folded(self.target), mask=mask, shape=shape)

    def _unfolded(self, images: Tensor) -> Tensor:
        return images if self.shape is None else images.reshape(self.shape)


def _check_layout(target: Tensor, channels_last: bool) -> None:
    first, last = (target.shape[-3], target.shape[-1])
    if channels_last:
        first, last = last, first
    if first > 4 and last in (1, 3, 4):
        raise LegsError(
            f"target {list(target.shape)} has its channels {'first' if channels_last else 'last'}: "
            f"call l1_loss with channels_last={not channels_last}"
        )
