"""Scenes with transforms.json: nerfstudio's and instant-ngp's, and NeRF's synthetic ones."""

from __future__ import annotations

import json
import math
import os
import posixpath
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional

import numpy as np
from numpy.linalg import LinAlgError

from legs_loss.errors import LegsError
from legs_loss.scenes.folder import SUFFIXES
from legs_loss.scenes.images import image_size
from legs_loss.scenes.model import Camera, Scene, View, is_lens
from legs_loss.system.files import read_text

_LARGEST = 1 << 30  # bytes
_SPLITS = ("train", "test", "val")
# OpenGL's camera looks along -z with y up; OpenCV's along z with y down.
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

# What reading a document of any other shape raises.
_WRONG = (ArithmeticError, ValueError, TypeError, LookupError, AttributeError, RecursionError, LinAlgError)


def find_transforms(root: Path) -> List[Path]:
    """Return NeRF's ``transforms_{train,test,val}.json``, else ``transforms.json``; [] without any."""
    files = [root / f"transforms_{split}.json" for split in _SPLITS]
    return [file for file in (files if files[0].is_file() else [root / "transforms.json"]) if file.is_file()]


def read_transforms(root: Path) -> Scene:
    """Read a scene whose views are listed in JSON.

    A frame's intrinsics are its own, else the file's; ``file_path`` may lack its extension. A
    distorted camera leaves ``View.camera`` None, and so does an image of unknown
    size. A file listed twice keeps its first split. Raises :class:`LegsError` when a file is
    damaged.
    """
    views: Dict[str, View] = {}
    for file in find_transforms(root):
        try:
            for view in _read_file(root, file):
                views.setdefault(view.name, view)
        except OSError as error:
            raise LegsError(f"{file} cannot be read: {error.strerror}") from None
        except _WRONG as error:
            message = f"no {error}" if isinstance(error, KeyError) else error
            raise LegsError(f"{file} is damaged or is not a file of camera poses: {message}") from None
    return Scene(root, "transforms", tuple(views.values()))


def _read_file(root: Path, file: Path) -> Iterator[View]:
    common = json.loads(read_text(file, _LARGEST))
    one_split = file.stem.partition("_")[2] or None
    listed = {split: common.get(f"{split}_filenames") or () for split in _SPLITS}
    splits = {_image_name(root, name): split for split, names in listed.items() for name in names}
    for frame in common["frames"]:
        name = _image_name(root, frame["file_path"])
        intrinsics = {**common, **frame}
        model = _model(intrinsics)
        camera = _camera(intrinsics, root / name) if model in ("PINHOLE", "SIMPLE_PINHOLE") else None
        mask = root / _image_name(root, intrinsics["mask_path"]) if intrinsics.get("mask_path") else None
        yield View(name, root / name, camera, one_split or splits.get(name), model, True, mask)


def _image_name(root: Path, file_path: str) -> str:
    """Return the image's path relative to the scene, with the extension that the file on disk has."""
    if "\0" in file_path or not file_path:
        raise ValueError(f"a frame has the file_path {file_path!r}, which no file can have")
    name = posixpath.normpath(file_path.replace("\\", "/"))
    if os.path.isabs(name):
        name = Path(os.path.relpath(name, str(root.resolve()))).as_posix()
    for suffix in ("", *SUFFIXES, *map(str.upper, SUFFIXES)):
        if (root / f"{name}{suffix}").is_file():
            return f"{name}{suffix}"
    return name


def _model(intrinsics: Dict[str, Any]) -> str:
    """Return the name of the camera's model; OPENCV without any distortion is a PINHOLE."""
    distorted = any(intrinsics.get(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    model = intrinsics.get("camera_model", "OPENCV")
    return "PINHOLE" if model == "OPENCV" and not distorted else str(model)


def _camera(intrinsics: Dict[str, Any], image: Path) -> Optional[Camera]:
    """Return a frame's camera; None where its size is not written and the image cannot be opened."""
    try:
        width, height = (int(intrinsics[side]) for side in "wh") if "w" in intrinsics else image_size(image)
    except LegsError:  # the loader will report the error
        return None
    if "fl_x" in intrinsics:
        fx = float(intrinsics["fl_x"])
        fy = float(intrinsics.get("fl_y", fx))
    else:
        fx = width / 2 / math.tan(intrinsics["camera_angle_x"] / 2)
        angle = intrinsics.get("camera_angle_y")
        fy = fx if angle is None else height / 2 / math.tan(angle / 2)
    cx, cy = float(intrinsics.get("cx", width / 2)), float(intrinsics.get("cy", height / 2))
    if not is_lens(width, height, (fx, fy), (fx, fy, cx, cy)):
        raise ValueError(f"{str(image)!r} has a camera of {width}x{height} pixels, focal lengths {fx:g}, {fy:g}")
    camera_to_world = np.asarray(intrinsics["transform_matrix"], dtype=np.float64)
    if camera_to_world.shape == (3, 4):
        camera_to_world = np.vstack([camera_to_world, [0, 0, 0, 1]])
    if camera_to_world.shape != (4, 4) or not np.isfinite(camera_to_world).all():
        raise ValueError(f"the transform_matrix of {str(image)!r} is not a 4x4 matrix of numbers")
    pose = np.linalg.inv(camera_to_world @ _OPENGL_TO_OPENCV)
    if not np.isfinite(pose).all():
        raise ValueError(f"the transform_matrix of {str(image)!r} cannot be inverted")
    return Camera(width, height, fx, fy, cx, cy, pose)
