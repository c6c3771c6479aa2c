"""Scenes on disk: COLMAP, transforms.json and plain folders, all read as a list of views."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Optional, Tuple, Union

from legs_loss.errors import LegsError
from legs_loss.scenes.colmap import read_colmap
from legs_loss.scenes.folder import read_folder
from legs_loss.scenes.images import image_size as image_size
from legs_loss.scenes.images import image_tensor as image_tensor
from legs_loss.scenes.images import load_training_image as load_training_image
from legs_loss.scenes.images import open_image as open_image
from legs_loss.scenes.images import training_size as training_size
from legs_loss.scenes.model import Camera as Camera
from legs_loss.scenes.model import PointCloud as PointCloud
from legs_loss.scenes.model import Scene as Scene
from legs_loss.scenes.model import View as View
from legs_loss.scenes.transforms import find_transforms, read_transforms


def read_scene(path: Union[str, Path], images: Optional[str] = None) -> Scene:
    """Read a scene: COLMAP's layout, transforms.json, or any folder of images.

    The kind of scene follows 3DGS: ``sparse/`` makes it a COLMAP scene, otherwise
    ``transforms_train.json`` or ``transforms.json`` one with transforms. ``images`` names the
    folder of the photographs, in the scene or as a path ("images" by default); a scene with
    transforms names its files itself.

    Raises :class:`LegsError` when there is nothing to read or a file of the scene is damaged.
    A missing photograph is an error when it is loaded.
    """
    root = Path(path)
    if not root.is_dir():
        what = f"{root} is a file" if root.exists() else f"there is no folder {root}"
        raise LegsError(f"{what}: a scene is a folder")
    is_colmap = (root / "sparse").is_dir()
    if find_transforms(root) and not is_colmap:
        scene = read_transforms(root)
    elif is_colmap or images is not None or (root / "images").is_dir():
        scene = (read_colmap if is_colmap else read_folder)(root, *_images_folder(root, images or "images"))
    else:
        scene = read_folder(root, root, "")
    if not scene.views:
        raise LegsError(f"{root} has no photographs: its {scene.kind} files list none")
    return replace(scene, images=images, views=tuple(sorted(scene.views, key=lambda view: view.name)))


def from_anywhere(root: Path, named: Optional[str]) -> Optional[str]:
    """Return a folder or file that was named for a scene, in it or by a path, so that other current folders have it.

    What is in the scene stays as it was named, and so does what is nowhere.
    """
    if named is None or (root / named).exists() or not os.path.exists(named):
        return named
    return os.path.abspath(named)


def _images_folder(root: Path, images: str) -> Tuple[Path, str]:
    """Return the folder of the photographs and the prefix of their names."""
    folder = root / images  # pathlib keeps an absolute ``images`` as it is
    if not folder.is_dir():
        folder = Path(images)
        if not os.path.isdir(images):  # which raises nothing where the current folder may not be entered
            raise LegsError(f"there is no folder {root / images}: name the scene's images with --images")
    found, top = folder.resolve(), root.resolve()
    inside = found.relative_to(top).as_posix() if top in (found, *found.parents) else found.name
    return folder, f"{inside}/"
