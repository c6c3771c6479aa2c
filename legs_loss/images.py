"""Read the layout of images from their shapes, as every public function does, and check their values."""

from __future__ import annotations

from typing import NamedTuple, Optional, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss.autograd import is_compiling, is_transformed
from legs_loss.errors import LegsError

# A rendering may overshoot 1 and an HDR photograph may exceed it; 8-bit values are far larger.
SURELY_NOT_UNIT_RANGE = 16.0
_LARGEST_WEIGHT = 1e6  # float32 overflows in the sum over an image of larger ones
_CHANNELS = (1, 3, 4)  # of a photograph: gray, colour, colour and alpha; a rendering may have any number


def shape_of(tensor: Tensor) -> str:
    """Return a shape as it is printed in messages: ``[3, 4, 5]``."""
    return str(list(tensor.shape))


class Layout(NamedTuple):
    """Meaning of an image's axes: all of this package computes on [C, H, W] or [B, C, H, W].

    Attributes:
        shape: of the image as it was given.
        channels_last: whether its last axis is the channel.
    """

    shape: Sequence[int]
    channels_last: bool

    def channels_first(self, image: Tensor) -> Tensor:
        """Return an image of this layout as [C, H, W], or [B, C, H, W]: all axes in front of an image are one batch."""
        if len(self.shape) == 2:
            return image.unsqueeze(0)
        image = image.movedim(-1, -3) if self.channels_last else image
        return image.flatten(0, -4) if image.dim() > 4 else image

    def restored(self, image: Tensor) -> Tensor:
        """Return an image [..., C, H, W], of any number of channels, with its axes as they were given."""
        if len(self.shape) == 2:
            return image.squeeze(-3)
        if len(self.shape) > 4:
            image = image.reshape(*self.shape[:-3], *image.shape[-3:])
        return image.movedim(-3, -1) if self.channels_last else image

    def map_first(self, values: Optional[Tensor], image: Tensor, name: str) -> Optional[Tensor]:
        """Return a weight map or a mask as [1, H, W] or [B, 1, H, W]; None stays None.

        Args:
            values: one value a pixel: the given image's shape with one channel, or without the channel, and for a batch
                either one a view or one for all.
            image: one of the images, for its device.
            name: "weight" or "mask", for the message.

        Raises:
            LegsError: the shapes do not fit (the message names both), or the devices differ; a mask of whole numbers;
                on the CPU values that are NaN or negative, above 1 in a mask, above 1e6 in a weight.
        """
        if values is None:
            return None
        _check_tensor(values, name)
        if values.device != image.device:
            raise LegsError(f"{name} is on {values.device} and the images on {image.device}")
        if name == "mask" and values.dtype is not torch.bool and not values.is_floating_point():
            raise LegsError(f"mask is of type {values.dtype}: give bool, or floats in [0, 1] (8-bit: mask / 255.0)")
        batch = list(self.shape[:-3])
        height, width = self.shape[-3:-1] if self.channels_last else self.shape[-2:]
        one, none = ([height, width, 1] if self.channels_last else [1, height, width]), [height, width]
        shape, of_all = list(values.shape), (one, none)
        if shape not in of_all and not (batch and shape in (batch + one, batch + none)):
            wanted = f"{batch + one} or {batch + none}"
            raise LegsError(f"{name} {shape} does not fit images {list(self.shape)}: expected {wanted}")
        if values.device.type == "cpu" and values.dtype is not torch.bool and not (is_compiling() or is_transformed()):
            # By numpy: torch's threads would wait on the cores that the loss needs next.
            found = values.detach().resolve_neg().float().numpy()
            low, high = found.min(), found.max()
            most = 1.0 if name == "mask" else _LARGEST_WEIGHT
            if not (low > -1e-3 and high < most + 1e-3):  # a mask that was resized is rounded
                raise LegsError(f"{name} has values from {low:g} to {high:g}: give values in [0, {most:g}]")
        return values.reshape((1, height, width) if shape in of_all else (-1, 1, height, width))


def _check_tensor(values: object, name: str) -> None:
    if not isinstance(values, Tensor):
        raise LegsError(f"{name} must be a torch.Tensor, got {type(values).__name__}")
    if values.layout is not torch.strided:
        raise LegsError(f"{name} is sparse: give {name}.to_dense()")


def read_layout(image: Tensor, channels_last: Optional[bool] = None, name: str = "image") -> Layout:
    """Return the layout of an image, as its shape shows it.

    Args:
        image: floats, [H, W], [C, H, W] or [B, C, H, W], with more axes in front, or with the channel last. The channel
            is the one of the two axes that is 1, 3 or 4.
        channels_last: the caller's word, where both axes read well, as in [3, 100, 4], or neither, as in [16, 90, 120].
        name: of the image, for messages.

    Raises:
        LegsError: it is no float tensor, has too few axes or an empty one; its channel may be either axis or
            neither, and ``channels_last`` is None; its shape contradicts ``channels_last``; it is a list of pixels.

    Examples:
        >>> read_layout(torch.zeros(1, 6, 8, 3)).channels_last
        True
    """
    _check_tensor(image, name)
    if not isinstance(channels_last, (bool, type(None))):
        raise LegsError(f"channels_last must be True, False or None, got {channels_last!r}")
    if not image.is_floating_point():
        raise LegsError(f"{name} is of type {image.dtype}: give floats in [0, 1] (8-bit images: image / 255.0)")
    if image.dim() == 0 or image.numel() == 0:
        raise LegsError(f"{name} must be an image [H, W], [C, H, W] or [H, W, C], or a batch, got {shape_of(image)}")
    if image.dim() == 1 or (image.dim() == 2 and not {*image.shape}.isdisjoint(_CHANNELS)):
        raise LegsError(f"{name} {shape_of(image)} is a list of pixels: a weight map needs the whole image, [C, H, W]")
    if image.dim() == 2:
        return Layout(image.shape, False)
    first, last = image.shape[-3], image.shape[-1]
    if channels_last is None:
        # Not compared with ==: torch.compile can branch on conditions of sizes that change, not compare them.
        if first in _CHANNELS and last not in _CHANNELS:
            return Layout(image.shape, False)
        if last in _CHANNELS and first not in _CHANNELS:
            return Layout(image.shape, True)
        raise LegsError(
            f"{name} {shape_of(image)} may have its channels first or last: say channels_last=False ({first} "
            f"channels) or channels_last=True ({last} channels); gray images are [..., {first}, 1, H, W]"
        )
    channel, other = (last, first) if channels_last else (first, last)
    if channel > max(_CHANNELS) and other in _CHANNELS:
        what = f"{name} {shape_of(image)} has its channels {'first' if channels_last else 'last'}"
        raise LegsError(f"{what}: leave channels_last={channels_last} out of the call")
    return Layout(image.shape, channels_last)


def read_pair(
    prediction: Tensor, target: Tensor, channels_last: Optional[bool] = None
) -> Tuple[Layout, Tensor, Tensor]:
    """Return the layout of a prediction and its target as they were given, and both as [C, H, W] or [B, C, H, W].

    An image beside a batch of one image becomes a batch of one.

    Raises:
        LegsError: as :func:`read_layout`; their shapes or devices differ (the message names both).
    """
    if isinstance(prediction, Tensor) and isinstance(target, Tensor):
        if target.shape == (1, *prediction.shape):
            prediction = prediction.unsqueeze(0)
        elif prediction.shape == (1, *target.shape):
            target = target.unsqueeze(0)
        if prediction.shape != target.shape:
            raise LegsError(f"prediction {shape_of(prediction)} and target {shape_of(target)} differ in shape")
    read_layout(prediction, channels_last, "prediction")
    layout = read_layout(target, channels_last, "target")
    if prediction.device != target.device:
        raise LegsError(f"prediction is on {prediction.device} and target on {target.device}: move one of them first")
    return layout, layout.channels_first(prediction), layout.channels_first(target)


def check_values(image: Tensor, name: str = "target") -> None:
    """Check that every value is finite and plausibly in [0, 1]. Reads from the device, so it waits for it.

    Raises:
        LegsError: there is a NaN or an infinity, or values that can only be of 0..255.
    """
    largest = float(image.detach().abs().amax())
    if largest != largest or largest == float("inf"):
        why = "a weight map cannot be made from it; look at how this view is loaded"
        raise LegsError(f"{name} {shape_of(image)} has values that are NaN or infinite: {why}")
    if largest > SURELY_NOT_UNIT_RANGE:
        what = f"{name} {shape_of(image)} has values up to {largest:g}"
        raise LegsError(f"{what}: images are in [0, 1] here (8-bit images: image / 255.0)")
