"""Photographs as 3DGS's own loader prepares them for the training: the same size, the same pixels.

Source of the rules: utils/camera_utils.py, utils/general_utils.py and scene/dataset_readers.py of 3DGS.
"""

from __future__ import annotations

from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Iterator, Tuple

import numpy as np
import torch
from torch import Tensor

from legs_loss.errors import LegsError
from legs_loss.scenes.model import View
from legs_loss.system.files import open_regular

WIDEST = 1600  # pixels; 3DGS shrinks wider photographs to this unless -r says otherwise
STRIP_PIXELS = 1 << 16
_WIDTH = 1 << 30  # pixels: no image is wider
# Pillow identifies files by content, and runs other programs for some formats: Ghostscript for EPS. These formats are
# decoded in this process; HEIF where pillow-heif is installed and registered.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM", "TGA", "GIF", "JPEG2000", "AVIF", "HEIF")


def training_size(width: int, height: int, resolution: int = -1) -> Tuple[int, int]:
    """Return the width and height in pixels that 3DGS trains a photograph at.

    Args:
        width, height: of the photograph, in pixels.
        resolution: 3DGS's ``-r``: 1, 2, 4 or 8 divides both sides and rounds; -1 keeps the size up to a width of
            1600 pixels; any other number is the width. The last two cut fractions off instead of rounding, in floating
            point: a width of 1601 becomes 1599.

    Raises:
        LegsError: the resolution is none of these, or leaves no pixel.

    Examples:
        >>> training_size(4032, 3024), training_size(4032, 3025, 4), training_size(1000, 701, 500)
        ((1600, 1200), (1008, 756), (500, 350))
    """
    if resolution in (1, 2, 4, 8):
        size = round(width / resolution), round(height / resolution)
    elif resolution == -1 or 0 < resolution <= _WIDTH:
        wanted = min(width, WIDEST) if resolution == -1 else resolution
        scale = width / wanted
        size = int(width / scale), int(height / scale)
    else:
        raise LegsError(f"resolution must be 1, 2, 4, 8, -1 (at most {WIDEST} wide) or a width, got {resolution}")
    if min(size) < 1:
        raise LegsError(f"resolution {resolution} leaves no pixel of an image of {width}x{height}")
    return size


def load_training_image(view: View, resolution: int = -1, white_background: bool = False) -> np.ndarray:
    """Return a view's photograph as 3DGS's loader makes it: read, laid on a background, resized.

    Args:
        view: of a scene. With ``view.composited`` (a scene with transforms.json) the photograph is laid over the
            background with its alpha at full size, cut to 8 bits, then resized, as 3DGS of 2023 and FastGS do.
            Elsewhere its alpha is resized with it and dropped: 3DGS never multiplies the target's colour by alpha.
        resolution: see :func:`training_size`.
        white_background: 3DGS's ``-w``, for ``composited`` views: white in place of black.

    Returns:
        uint8 [H, W, C], C = 3, or 1 for a gray photograph; uint16 for a gray one of 16 bits (16-bit colour is read
        as 8 bits). The resampling is Pillow's default, as in 3DGS. EXIF orientation is not applied: neither 3DGS
        nor COLMAP does. Palettes, CMYK and the like become RGB (3DGS reads a palette's indices as gray values).

    Raises:
        LegsError: no such file, a file that Pillow cannot decode, or floats.
    """
    from PIL import Image

    with open_image(view.path) as image:
        size = training_size(image.width, image.height, resolution)
        if image.mode.startswith("I"):
            values = np.asarray(Image.fromarray(deep_gray(image)).resize(size))
            # Pillow's cubic overshoots beside a step; 8-bit images are clipped by Pillow itself.
            return np.clip(values, 0, 65535).astype(np.uint16)[:, :, None]
        if view.composited:
            prepared = _on_background(image.convert("RGBA"), 255 if white_background else 0)
        else:
            mode = colour_mode(image)
            prepared = image if image.mode == mode else image.convert(mode)
        return _pixels(prepared if prepared.size == size else prepared.resize(size))


def image_size(path: Path) -> Tuple[int, int]:
    """Return the width and height in pixels of an image file, from its header.

    Raises:
        LegsError: no such file, or none that Pillow can read.
    """
    with open_image(path) as image:
        return image.size


def image_tensor(image: np.ndarray) -> Tensor:
    """Return a photograph uint8 or uint16 [H, W, C] as float32 [C, H, W] in [0, 1].

    Examples:
        >>> image_tensor(np.full((1, 2, 3), 255, np.uint8)).shape
        torch.Size([3, 1, 2])
    """
    channels_first = image.transpose(2, 0, 1).astype(np.float32, order="C")
    return torch.from_numpy(channels_first).div_(np.iinfo(image.dtype).max)


@contextmanager
def open_image(path: Path) -> Iterator[Any]:
    """Open a photograph with Pillow, in one of :data:`FORMATS`; all images of the user are opened here.

    Raises:
        LegsError: for any error while it is open; the message names the file.
    """
    from PIL import Image

    try:
        with open_regular(path) as file, Image.open(file, formats=_formats()) as image:
            yield image
    except LegsError as error:
        raise LegsError(f"{path}: {error}") from None
    except FileNotFoundError:
        raise LegsError(f"{path}: there is no such file") from None
    except MemoryError:
        raise
    except Image.UnidentifiedImageError:
        raise LegsError(f"{path}: not an image in a format that is read here ({', '.join(_formats())})") from None
    except Exception as error:  # Pillow's decoders raise nearly anything on a damaged file
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise LegsError(f"{path}: not an image that Pillow can read ({why})") from None


@lru_cache(maxsize=None)
def _formats() -> Tuple[str, ...]:
    """Return those of :data:`FORMATS` that this Pillow was built with."""
    from PIL import Image

    Image.init()
    return tuple(name for name in FORMATS if name in Image.OPEN)


def is_readable(path: Path) -> bool:
    """Return whether a file's ending is one of :data:`FORMATS` that this Pillow decodes; of floats none is."""
    from PIL import Image

    formats, suffix = _formats(), path.suffix.lower()  # the formats first: their endings are known then
    return suffix != ".pfm" and Image.registered_extensions().get(suffix) in formats


def row_strips(height: int, width: int) -> Iterator[slice]:
    """Cut an image into strips of rows, small enough that temporaries of one hardly count."""
    rows = max(1, STRIP_PIXELS // width)
    return (slice(start, min(start + rows, height)) for start in range(0, height, rows))


def _pixels(image: Any) -> np.ndarray:
    """Return an image's values without its alpha, [H, W, C]; in strips: Pillow copies values three times."""
    width, height = image.size
    pixels = np.empty((height, width, 1 if image.mode == "L" else 3), np.uint8)
    for rows in row_strips(height, width):
        strip = np.asarray(image.crop((0, rows.start, width, rows.stop)))
        pixels[rows] = strip[:, :, :3] if strip.ndim == 3 else strip[:, :, None]
    return pixels


def colour_mode(image: Any) -> str:
    """Return the one of L, RGB and RGBA that keeps what the image shows."""
    if image.mode == "F":
        raise LegsError("an image of floats: save it with 8 or 16 bits")
    if image.mode in ("L", "1"):
        return "L"
    transparent = image.mode == "P" and "transparency" in image.info
    return "RGBA" if transparent or image.mode in ("RGBA", "RGBa", "LA", "La", "PA") else "RGB"


def _on_background(image: Any, background: int) -> Any:
    from PIL import Image

    rgba = np.asarray(image)
    flat = np.empty(rgba.shape[:2] + (3,), np.uint8)
    for rows in row_strips(*rgba.shape[:2]):
        # In float64 and cut, not rounded: this decides the last bit, and so the fingerprint.
        unit = rgba[rows] / 255.0
        colour, alpha = unit[..., :3], unit[..., 3:]
        flat[rows] = (colour * alpha + background / 255.0 * (1.0 - alpha)) * 255.0
    return Image.fromarray(flat)


def deep_gray(image: Any) -> np.ndarray:
    """Return the values of a gray image of 16 bits, int32 [H, W]."""
    values = np.asarray(image).astype(np.int32)
    if values.min() < 0 or values.max() > 65535:
        raise LegsError("a gray image of more than 16 bits: save it with 8 or 16 bits")
    return values
