"""The user's own maps, masks and weights: found by their photographs' names, read, and averaged to a size."""

from __future__ import annotations

import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Dict, Iterable, List, Sequence, Tuple, Type

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.scenes.folder import SUFFIXES, files_below
from legs_loss.scenes.images import colour_mode, deep_gray, open_image
from legs_loss.scenes.model import View
from legs_loss.system.files import read_regular, write_whole

ALPHA, MASK_PATH = "alpha", "mask_path"  # in place of a path: the photographs' own, those that transforms.json names
_GRAY = 32  # of 255: the colours of a pixel of a gray JPEG differ less
_LARGEST = 4 << 30  # bytes of a .npy
_DARK = 0.1  # of white: a mask whose lightest pixel is darker shows something else
_BOX = 4  # Image.BOX, whose home differs between versions of Pillow


def map_path(root: Path, named: str) -> Path:
    """Return the file or folder of maps that was named: in the scene, or a path."""
    return root / named if (root / named).exists() else Path(named)


def find_maps(
    root: Path, named: str, views: Sequence[View], suffixes: Sequence[str] = SUFFIXES
) -> Tuple[Dict[str, Path], List[Path]]:
    """Return the map's file of each view that has one, by the view's name, and the files that are of no view.

    Args:
        root, views: of the scene.
        named: a folder, a file for all views, :data:`ALPHA` or :data:`MASK_PATH`. In a folder a file is a view's by the
            last parts of its path: ``0001.png`` or ``cam/0001.png`` for the photograph ``images/cam/0001.jpg``, and
            ``0001.jpg.png`` as COLMAP names masks. Hidden files and folders are left out.
        suffixes: of the files.

    Raises:
        LegsError: there is no such path, or no map; a map fits several photographs; a photograph has two maps.
    """
    path, missing = map_path(root, named), f"no map of a photograph ({', '.join(suffixes)})"
    strays: List[Path] = []
    if named == ALPHA:
        found = {view.name: view.path for view in views if _has_alpha(view.path)}
        missing = f"none of the {len(views)} photographs has an alpha channel"
    elif named == MASK_PATH:
        found = {view.name: view.mask for view in views if view.mask is not None}
        missing = "no transforms.json names one for a photograph"
    elif path.is_file():
        return {view.name: path for view in views}, []
    elif path.is_dir():
        found, strays = _in_folder(path, views, suffixes)
    else:
        raise LegsError(f"there is no folder or file {path}")
    if strays and not found:
        missing = f"{strays[0]} belongs to no photograph: a map has the name of its own, 0001.png or 0001.jpg.png"
    if not found:
        raise LegsError(f"{named}: {missing}")
    return found, strays


def _in_folder(folder: Path, views: Sequence[View], suffixes: Sequence[str]) -> Tuple[Dict[str, Path], List[Path]]:
    of: Dict[str, List[str]] = {}
    for view in views:
        parts = view.name.split("/")
        for start in range(len(parts)):
            last = "/".join(parts[start:])
            for name in {last, os.path.splitext(last)[0]}:
                of.setdefault(name, []).append(view.name)
    found: Dict[str, Path] = {}
    strays = []
    for path in sorted(files_below(folder, suffixes)):
        fits = of.get(os.path.splitext(path.relative_to(folder).as_posix())[0], [])
        if len(fits) > 1:
            raise LegsError(f"{path} fits {len(fits)} photographs: {', '.join(fits[:3])}; put it into their folder")
        if not fits:
            strays.append(path)
        elif fits[0] in found:
            raise LegsError(f"{found[fits[0]]} and {path} are both maps of {fits[0]}: remove one of them")
        else:
            found[fits[0]] = path
    return found, strays


def read_mask(path: Path, named: str, size: Tuple[int, int]) -> np.ndarray:
    """Return a mask that :func:`find_maps` found by the same name, float32 [H, W] in [0, 1].

    Raises:
        LegsError: as :func:`read_map_file`; or it is nearly black everywhere, as an image of labels is.
    """
    if named == ALPHA:
        with open_image(path) as image:
            return (np.asarray(image.convert("RGBA"))[..., 3] / 255.0).astype(np.float32)
    mask = read_map_file(path, size)
    if 0 < mask.max() < _DARK:
        raise LegsError(
            f"{path}: no pixel is lighter than {mask.max() * 255:.3g} of 255: in a mask white counts and black does "
            "not; an image of labels is no mask"
        )
    return mask


def read_map_file(path: Path, size: Tuple[int, int]) -> np.ndarray:
    """Return a map float32 [H, W]: of an image in [0, 1] (white is 1), of a .npy as it is.

    Palettes, 1 bit, 8 and 16 bits are gray values; what is transparent is black. Where the largest value is 1, all are
    0 or 1, and 1 is white. As of photographs, EXIF's orientation is not applied.

    Args:
        path: the file.
        size: width and height of its photograph, checked before an image's pixels are read.

    Raises:
        LegsError: it cannot be read, its ratio of sides is not the photograph's, it is in colour, or has negative
            values, or ones that are no numbers.
    """
    if path.suffix.lower() == ".npy":
        return _array(path, size)
    with open_image(path) as image:
        _check_ratio(image.size, size)
        if image.mode.startswith("I"):
            return _unit(deep_gray(image), 65535)
        pixels = np.asarray(image.convert(colour_mode(image)).convert("RGBA")).astype(np.int16)
        colours, opacity = pixels[..., :3], pixels[..., 3]
        if (np.ptp(colours, -1)[opacity > 0] > _GRAY).any():
            raise LegsError("in colour, and a map is gray (for a photograph's own alpha: --masks alpha)")
        return _unit(colours.mean(-1), 255) * (opacity / 255.0).astype(np.float32)


def _unit(values: np.ndarray, white: int) -> np.ndarray:
    return (values / (1 if values.max() == 1 else white)).astype(np.float32)


def _has_alpha(path: Path) -> bool:
    """Return whether a photograph has an alpha channel, from its header; one that cannot be read has none."""
    with suppress(LegsError), open_image(path) as image:
        return colour_mode(image) == "RGBA"
    return False


def file_names(views: Iterable[str]) -> Dict[str, str]:
    """Return the names of the views' maps, as PNG: as photographs are called in the scene's folder of photographs.

    >>> file_names(["images/cam/1.jpg", "images/2.jpg"])
    {'images/cam/1.jpg': 'cam/1.png', 'images/2.jpg': '2.png'}
    """
    views = list(views)
    folders = {view.split("/")[0] if "/" in view else "" for view in views}
    skipped = len(next(iter(folders))) + 1 if len(folders) == 1 and folders != {""} else 0
    return {view: f"{os.path.splitext(view[skipped:])[0]}.png" for view in views}


def write_gray(path: Path, values: np.ndarray, kind: Type[np.unsignedinteger] = np.uint8) -> None:
    """Write a map in [0, 1] as a gray PNG."""
    from PIL import Image

    whole = np.rint(values * np.iinfo(kind).max).astype(kind)
    write_whole(path, lambda file: Image.fromarray(whole).save(file, "PNG"), folders=True)


def averaged(values: np.ndarray, size: Tuple[int, int]) -> np.ndarray:
    """Return a map at a width and height; each value is the mean over the area that its pixel covers.

    >>> averaged(np.float32([[0, 1, 1, 1], [0, 0, 1, 1]]), (2, 1))
    array([[0.25, 1.  ]], dtype=float32)
    """
    from PIL import Image

    if values.shape == (size[1], size[0]):
        return values
    return np.asarray(Image.fromarray(values).resize(size, _BOX))


def _check_ratio(map_size: Tuple[int, int], size: Tuple[int, int]) -> None:
    """Check that a map of one size can be of a photograph of another, up to the rounding of its sides to pixels."""
    (across, down), (width, height) = map_size, size
    if abs(across * height - down * width) > max(width, height):
        raise LegsError(f"{across}x{down} pixels do not have the ratio of sides of its photograph, {width}x{height}")


def _array(path: Path, size: Tuple[int, int]) -> np.ndarray:
    try:
        found = np.load(io.BytesIO(read_regular(path, _LARGEST)), allow_pickle=False)
        if not isinstance(found, np.ndarray) or found.ndim != 2 or found.dtype.kind != "f":
            raise LegsError("not floats of [height, width]")
        _check_ratio(found.shape[::-1], size)
        values: np.ndarray = found.astype(np.float32)
        if not (np.isfinite(values).all() and values.min() >= 0):
            raise LegsError("it has negative values, or values that are not finite")
        return values
    except LegsError as error:
        raise LegsError(f"{path}: {error}") from None
    except Exception as error:  # numpy reads a header as Python, whose tokenizer and parser raise many kinds
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise LegsError(f"{path}: not an array that can be read ({why})") from None
