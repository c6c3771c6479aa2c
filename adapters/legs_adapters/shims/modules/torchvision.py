"""The few helpers of torchvision that training scripts use, for machines without it.

PyPI's wheels of torchvision are built for CUDA: beside a torch for the CPU their import ends in an error.

ToTensor, ToPILImage, Compose, Resize; save_image, make_grid; reading and writing pictures. Everything else can be
imported, and raises an error when it is used.
"""

from __future__ import annotations

import enum
import io
import math
import types
from typing import Any, List, Optional, Sequence, Tuple, Union

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from legs_adapters.shims.inria.survey import Interface
from legs_adapters.shims.missing import complete

__all__ = ["module"]

REAL_FIRST = True

BILINEAR: Any = 2  # Pillow moved the name


def to_tensor(pic: Any) -> Tensor:
    """Convert a PIL image or an array [H, W, C] to [C, H, W]; 8-bit values to [0, 1], other types as they are."""
    array = np.array(pic, copy=True)
    array = array[:, :, None] if array.ndim == 2 else array
    tensor = torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))
    if tensor.dtype == torch.bool:
        return 255 * tensor.to(torch.float32) / 255
    return tensor.to(torch.float32).div(255) if tensor.dtype == torch.uint8 else tensor


def to_pil_image(pic: Any, mode: Optional[str] = None) -> Any:
    """Return a PIL image of a tensor [C, H, W], floats in [0, 1] or uint8, or of an array [H, W, C]."""
    if isinstance(pic, Tensor):
        pic = pic[None] if pic.dim() == 2 else pic
        pic = pic.mul(255).to(torch.uint8) if pic.is_floating_point() else pic
        pic = pic.detach().cpu().permute(1, 2, 0).numpy()
    array = pic[:, :, 0] if pic.ndim == 3 and pic.shape[2] == 1 else pic
    return Image.fromarray(np.ascontiguousarray(array), mode) if mode else Image.fromarray(np.ascontiguousarray(array))


def resize(img: Any, size: Union[int, Sequence[int]], interpolation: Any = None, *_: Any, **__: Any) -> Any:
    """Resize bilinearly to (height, width), or so that the shorter side is ``size``."""
    height, width = img.shape[-2:] if isinstance(img, Tensor) else (img.height, img.width)
    if isinstance(size, int) or len(size) == 1:
        shorter = size if isinstance(size, int) else size[0]
        scale = shorter / min(height, width)
        size = (shorter, int(width * scale)) if height <= width else (int(height * scale), shorter)
    if not isinstance(img, Tensor):
        return img.resize((size[1], size[0]), BILINEAR if interpolation is None else interpolation)
    batch = img if img.dim() == 4 else img[None]
    resized = torch.nn.functional.interpolate(batch, tuple(size), mode="bilinear", align_corners=False, antialias=True)
    return resized if img.dim() == 4 else resized[0]


def make_grid(
    tensor: Union[Tensor, List[Tensor]],
    nrow: int = 8,
    padding: int = 2,
    normalize: bool = False,
    value_range: Optional[Tuple[float, float]] = None,
    pad_value: float = 0.0,
    **_: Any,
) -> Tensor:
    """Return images [B, C, H, W] in rows of ``nrow`` with a border, [3, H', W']; one image without a border."""
    images = torch.stack(list(tensor)) if isinstance(tensor, (list, tuple)) else tensor
    images = images[None, None] if images.dim() == 2 else images[None] if images.dim() == 3 else images
    images = images.expand(-1, 3, -1, -1) if images.shape[1] == 1 else images
    if normalize:
        low, high = value_range if value_range is not None else (float(images.min()), float(images.max()))
        images = (images.clamp(low, high) - low) / max(high - low, 1e-5)
    if len(images) == 1:
        return images[0]
    columns = min(nrow, len(images))
    rows = math.ceil(len(images) / columns)
    height, width = images.shape[2] + padding, images.shape[3] + padding
    grid = images.new_full((images.shape[1], height * rows + padding, width * columns + padding), pad_value)
    for i, image in enumerate(images):
        top, left = i // columns * height + padding, i % columns * width + padding
        grid[:, top : top + image.shape[1], left : left + image.shape[2]] = image
    return grid


def save_image(tensor: Union[Tensor, List[Tensor]], fp: Any, format: Optional[str] = None, **options: Any) -> None:
    """Write images in [0, 1], several as a grid, rounded to 8 bits."""
    grid = make_grid(tensor, **options)
    pixels = grid.detach().mul(255).add(0.5).clamp(0, 255).permute(1, 2, 0).to("cpu", torch.uint8).numpy()
    Image.fromarray(pixels).save(fp, format=format)


FORMATS = ("JPEG", "PNG", "GIF", "WEBP")  # as torchvision decodes them


class ImageReadMode(enum.Enum):
    """Return an image with the requested channels."""

    UNCHANGED = None
    GRAY = "L"
    GRAY_ALPHA = "LA"
    RGB = "RGB"
    RGB_ALPHA = "RGBA"


def read_image(path: Any, mode: ImageReadMode = ImageReadMode.UNCHANGED, **_: Any) -> Tensor:
    """Read a file as [C, H, W], in its own type."""
    with Image.open(path, formats=FORMATS) as image:
        array = np.array(image if mode.value is None else image.convert(mode.value))
    array = array[:, :, None] if array.ndim == 2 else array
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1)))


def decode_image(input: Any, mode: ImageReadMode = ImageReadMode.UNCHANGED, **_: Any) -> Tensor:
    """Read an image like `read_image`, from a file or from its bytes in a tensor."""
    return read_image(io.BytesIO(input.numpy().tobytes()) if isinstance(input, Tensor) else input, mode)


def write_png(input: Tensor, filename: Any, compression_level: int = 6) -> None:
    """Write a picture, uint8 [C, H, W]."""
    to_pil_image(input).save(filename, format="PNG", compress_level=compression_level)


def write_jpeg(input: Tensor, filename: Any, quality: int = 75) -> None:
    """Write a picture, uint8 [C, H, W]."""
    to_pil_image(input).save(filename, format="JPEG", quality=quality)


class ToTensor:
    """`to_tensor` as a transform."""

    def __call__(self, pic: Any) -> Tensor:
        return to_tensor(pic)


class ToPILImage:
    """`to_pil_image` as a transform."""

    def __init__(self, mode: Optional[str] = None) -> None:
        self.mode = mode

    def __call__(self, pic: Any) -> Any:
        return to_pil_image(pic, self.mode)


class Resize:
    """`resize` as a transform."""

    def __init__(self, size: Union[int, Sequence[int]], interpolation: Any = None, *_: Any, **__: Any) -> None:
        self.size: Union[int, Sequence[int]] = size
        self.interpolation: Any = interpolation

    def __call__(self, img: Any) -> Any:
        return resize(img, self.size, self.interpolation)


class Compose:
    """Apply transforms one after the other."""

    def __init__(self, transforms: Sequence[Any]) -> None:
        self.transforms: List[Any] = list(transforms)

    def __call__(self, img: Any) -> Any:
        for transform in self.transforms:
            img = transform(img)
        return img


def module(name: str, interface: Interface) -> types.ModuleType:
    """Return ``torchvision`` with ``transforms``, ``transforms.functional``, ``utils``, ``io`` and ``models``."""

    def part(path: str, *contents: Any) -> types.ModuleType:
        return complete(f"{name}.{path}", None, *contents, deferred=True)

    return complete(
        name,
        __doc__,
        part(
            "transforms",
            *(ToTensor, ToPILImage, Resize, Compose),
            part("transforms.functional", to_tensor, to_pil_image, resize),
        ),
        part("utils", make_grid, save_image),
        part("io", ImageReadMode, read_image, decode_image, write_png, write_jpeg),
        part("models"),
        deferred=True,
    )
