"""A plain folder of images, read as a scene without cameras."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Iterator, Sequence

from legs_loss.errors import LegsError
from legs_loss.scenes.images import is_readable
from legs_loss.scenes.model import Scene, View

_COMMON = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".jfif", ".jpe", ".gif", ".tga", ".ppm", ".pgm")
# The formats of legs_loss.scenes.images; those that every decoder of photographs knows come first.
SUFFIXES = (*_COMMON, ".jp2", ".j2k", ".jpf", ".jpx", ".avif", ".heic", ".heif", ".hif")
_UNREAD = (".jxl", ".exr", ".hdr", ".pfm", ".psd", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
PHOTOGRAPHS = (*SUFFIXES, *_UNREAD)  # with those that are not read: raw ones, floats, layers


def files_below(folder: Path, suffixes: Sequence[str]) -> Iterator[Path]:
    """Yield the files with one of these endings in a folder and below, but nothing hidden."""
    for above, folders, files in os.walk(str(folder)):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for file in files:
            if os.path.splitext(file)[1].lower() in suffixes and not file.startswith("."):
                yield Path(above, file)


def left_out(names: Sequence[str]) -> str:
    """Return the sentence that names photographs whose format is not read."""
    named = ", ".join(sorted(names)[:4]) + (", ..." if len(names) > 4 else "")
    return f"{len(names)} file(s) in a format that is not read here are left out: {named}; convert them to PNG or JPEG"


def read_folder(root: Path, images: Path, prefix: str) -> Scene:
    """Read every image in ``images`` and below; hidden folders and files are left out.

    ``prefix`` goes before a view's name. Raises :class:`LegsError` where there is no image.
    """
    files = {f"{prefix}{path.relative_to(images).as_posix()}": path for path in files_below(images, PHOTOGRAPHS)}
    views = tuple(View(name, path) for name, path in files.items() if is_readable(path))
    left = [name for name, path in files.items() if not is_readable(path)]
    notes = (left_out(left),) if left else ()
    if not views:
        why = notes[0] if notes else f"no images ({', '.join(SUFFIXES)})"
        raise LegsError(f"{images} is not a scene: it has no sparse/ of COLMAP, no transforms.json and {why}")
    return Scene(root, "folder", views, notes=notes)
