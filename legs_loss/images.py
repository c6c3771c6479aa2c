"""Check images and their layouts, as every public function does."""

from __future__ import annotations

import torch
from torch import Tensor

from legs_loss.errors import LegsError

__all__ = ["as_map", "channels_first", "check_image", "check_pair", "check_values", "is_compiling", "shape_of"]

# A rendering may overshoot 1 and an HDR photograph may exceed it; 8-bit values are far larger.
_SURELY_NOT_UNIT_RANGE = 16.0


def is_compiling() -> bool:
    """Return whether torch.compile is tracing: checks that read values from the device are skipped then."""
    compiler = getattr(torch, "compiler", None)
    probe = getattr(compiler, "is_compiling", None)
    return bool(probe()) if probe is not None else False


def shape_of(tensor: Tensor) -> str:
    """Return a shape as it is printed in messages: ``[3, 4, 5]``."""
    return str(list(tensor.shape))


def check_image(image: Tensor, name: str = "image") -> None:
    """Check that this is a float tensor of three or four dimensions, none of them empty.

    Raises:
        LegsError: it is not; the message names the type or the shape.
    """
    if not isinstance(image, Tensor):
        raise LegsError(f"{name} must be a torch.Tensor, got {type(image).__name__}")
    if not image.is_floating_point():
        raise LegsError(f"{name} is of type {image.dtype}: give floats in [0, 1] (8-bit images: image / 255.0)")
    if image.dim() not in (3, 4) or image.numel() == 0:
        raise LegsError(
            f"{name} must be an image [C, H, W] or a batch [B, C, H, W] (channels_last=True: "
            f"[H, W, C] or [B, H, W, C]), got {shape_of(image)}"
        )


def check_pair(prediction: Tensor, target: Tensor) -> None:
    """Check that prediction and target are images of one shape on one device.

    Raises:
        LegsError: they are not; the message names both shapes or both devices.
    """
    check_image(prediction, "prediction")
    check_image(target, "target")
    if prediction.shape != target.shape:
        raise LegsError(f"prediction {shape_of(prediction)} and target {shape_of(target)} differ in shape")
    if prediction.device != target.device:
        raise LegsError(f"prediction is on {prediction.device} and target on {target.device}: move one of them first")


def check_values(image: Tensor, name: str = "target") -> None:
    """Check that every value is finite and plausibly in [0, 1]. Reads from the device, so it waits for it.

    Raises:
        LegsError: there is a NaN or an infinity, or values that can only be of 0..255.
    """
    largest = float(image.detach().abs().amax())
    if largest != largest or largest == float("inf"):
        bad = int((~torch.isfinite(image)).sum())
        raise LegsError(
            f"{name} {shape_of(image)} has {bad} value(s) that are NaN or infinite: "
            "a weight map cannot be made from it; look at how this view is loaded"
        )
    if largest > _SURELY_NOT_UNIT_RANGE:
        raise LegsError(
            f"{name} {shape_of(image)} has values up to {largest:g}: images are in [0, 1] here "
            "(8-bit images: image / 255.0)"
        )


def channels_first(image: Tensor, channels_last: bool) -> Tensor:
    """Return the image as [..., C, H, W], a view of the same memory."""
    return image.movedim(-1, -3) if channels_last else image


def as_map(values: Tensor, image: Tensor, channels_last: bool, name: str) -> Tensor:
    """Return a weight map or a mask in a shape that broadcasts over the image's channels.

    Args:
        values: one value a pixel: the image's shape with one channel, or without the channel, and for a batch
            either one a view or one for all.
        image: the image [C, H, W] or [B, C, H, W] that it belongs to (or channels-last).
        channels_last: where the image's channel stands.
        name: "weight" or "mask", for the message.

    Raises:
        LegsError: the shapes do not fit (the message names both), or the devices differ.
    """
    if not isinstance(values, Tensor):
        raise LegsError(f"{name} must be a torch.Tensor, got {type(values).__name__}")
    if values.device != image.device:
        raise LegsError(f"{name} is on {values.device} and the images on {image.device}")
    channel = image.dim() - (1 if channels_last else 3)
    one_channel = list(image.shape)
    one_channel[channel] = 1
    no_channel = one_channel[:channel] + one_channel[channel + 1 :]
    shape = list(values.shape)
    if shape == one_channel:
        return values
    if shape == no_channel:
        return values.unsqueeze(channel)
    if image.dim() == 4 and shape in (one_channel[1:], no_channel[1:]):
        return as_map(values, image[0], channels_last, name)
    raise LegsError(f"{name} {shape} does not fit images {shape_of(image)}: expected {one_channel} or {no_channel}")
