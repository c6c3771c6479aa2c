"""A plain folder of images, read as a scene without cameras."""

from __future__ import annotations

import os
from pathlib import Path
from typing import List

from legs_loss.errors import LegsError
from legs_loss.scenes.model import Scene, View

__all__ = ["SUFFIXES", "read_folder"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")


def read_folder(root: Path, images: Path, prefix: str) -> Scene:
    """Read every image in ``images`` and below; hidden folders and files are left out.

    ``prefix`` goes before a view's name. Raises :class:`LegsError` where there is no image.
    """
    views: List[View] = []
    for folder, folders, files in os.walk(str(images)):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for file in files:
            path = Path(folder, file)
            if path.suffix.lower() in SUFFIXES and not file.startswith("."):
                views.append(View(f"{prefix}{path.relative_to(images).as_posix()}", path))
    if not views:
        raise LegsError(
            f"{images} is not a scene: it has no sparse/ of COLMAP, no transforms.json and "
            f"no images ({', '.join(SUFFIXES)})"
        )
    return Scene(root, "folder", tuple(sorted(views, key=lambda view: view.name)))
