"""COLMAP's sparse model, binary or text: https://colmap.github.io/format.html."""

from __future__ import annotations

import os
import re
import struct
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Callable, Dict, Iterator, List, Optional, Sequence, Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.scenes.model import Camera, PointCloud, Scene, View, is_lens
from legs_loss.system.files import open_regular, read_text

# COLMAP's camera models in the order of their ids, each with its number of parameters.
MODELS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}

_LARGEST = 2 << 30  # bytes of a text, which is read whole; of a binary file as much is read as its counts say
_LONGEST = 4096  # bytes of an image's name
_FARTHEST_CAMERA = 1e12  # in the scene's unit: what float32 can still compute with


_Lens = Tuple[str, Optional[Camera]]  # the model's name; a pinhole as it stands in the origin
_Record = Tuple[Sequence[Any], int]  # of a binary file: the values, and how many bytes to skip
_Image = Tuple[str, int, np.ndarray]  # its name, its camera's number, and [4, 4], world -> camera


def read_colmap(root: Path, images: Path, prefix: str) -> Scene:
    """Read a scene in COLMAP's layout, its photographs from the folder ``images``.

    The model is in ``sparse/0`` or else in ``sparse``. A photograph is looked for under its whole COLMAP name and then,
    as 3DGS does, under the last part of it; ``prefix`` goes before its name in :class:`View`. Cameras other than
    PINHOLE and SIMPLE_PINHOLE leave ``View.camera`` None. Raises :class:`LegsError` when the model is damaged.
    """
    file = next((one for one in map(_images_file, (root / "sparse" / "0", root / "sparse")) if one.is_file()), None)
    if file is None:
        raise LegsError(f"{root} has no COLMAP model: there is no sparse/0/images.bin or .txt")
    cameras_file, points_file = (file.with_name(f"{what}{file.suffix}") for what in ("cameras", "points3D"))
    cameras = _read(cameras_file)
    views = []
    for listed_name, number, pose in _read(file):
        if number not in cameras:
            raise LegsError(f"{file}: {listed_name!r} has camera {number}, which {cameras_file.name} does not list")
        name = listed_name.replace("\\", "/")
        path = images / name
        if not os.path.isfile(str(path)) and os.path.isfile(str(images / path.name)):  # pathlib's raise for some names
            path, name = images / path.name, path.name
        model, pinhole = cameras[number]
        camera = None if pinhole is None else replace(pinhole, world_to_camera=pose)
        views.append(View(f"{prefix}{name}", path, camera, camera_model=model))
    points = partial(_read, points_file) if points_file.is_file() else None
    return Scene(root, "colmap", tuple(views), points, notes=_larger_models(root, file.parent, len(views)))


def _images_file(model: Path) -> Path:
    """Return the file that lists a model's images, by whose ending the others are chosen."""
    binary = model / "images.bin"
    return binary if binary.is_file() else model / "images.txt"


def _larger_models(root: Path, model: Path, count: int) -> Tuple[str, ...]:
    """Return a note where another of the models that COLMAP made has more images than the one that is read."""
    sizes = {}
    for folder in sorted((root / "sparse").iterdir()):
        if folder.name.isdigit() and folder != model:
            with suppress(LegsError):
                sizes[folder.name] = len(_read(_images_file(folder)))
    name = max(sizes, key=lambda name: sizes[name], default="")
    if sizes.get(name, 0) <= count:
        return ()
    return (
        f"COLMAP made several models: {root / 'sparse' / name} has {sizes[name]} images, and {model.name}, which is "
        f"read here as 3DGS does, has {count}; to use the larger one, rename it to 0",
    )


def _read(path: Path) -> Any:
    """Return the cameras by number, the images or the points of a model's file, by its name."""
    record, make, join, splits, layout = _FILES[path.stem]
    try:
        if path.suffix == ".txt":
            return join(list(_of_lines(read_text(path, _LARGEST), make, splits, layout)))
        with open_regular(path) as file:
            size, found = os.fstat(file.fileno()).st_size, []
            for _ in range(_take(file, "Q")[0]):
                values, skipped = record(file)
                found.append(make(*values))
                if skipped > size - file.tell():
                    raise ValueError("it ends too early")
                file.seek(skipped, os.SEEK_CUR)
            if file.tell() != size:
                raise ValueError(f"{size} bytes where its own counts say {file.tell()}")
            return join(found)
    except OSError as error:
        raise LegsError(f"cannot read {path}: {error.strerror}") from None
    except (struct.error, ValueError, OverflowError) as error:
        raise LegsError(f"{path} is not as COLMAP writes it: {error}") from None


def _of_lines(text: str, make: Callable[..., Any], splits: int, layout: str) -> Iterator[Any]:
    """Yield what is made of the values of each line that is no comment and not empty."""
    # Not by splitlines(), which also ends a line at characters that a name may have.
    lines = ((n, line) for n, line in enumerate(re.split(r"\r\n?|\n", text), 1) if not line.lstrip().startswith("#"))
    for number, line in lines:
        if line.strip():
            try:
                yield make(*line.rstrip().split(None, splits))
                if make is _image:
                    _check_points(*next(lines, (0, "")))
            except (ValueError, TypeError) as error:
                why = "too few values" if isinstance(error, TypeError) else error
                raise ValueError(f"line {number}, {line.strip()[:80]!r}: {why} (expected: {layout})") from None


def _take(file: BinaryIO, layout: str) -> Tuple[Any, ...]:
    return struct.unpack(f"<{layout}", file.read(struct.calcsize(f"<{layout}")))


def _camera_record(file: BinaryIO) -> _Record:
    number, model, width, height = _take(file, "iiQQ")
    if not 0 <= model < len(MODELS):
        known = f"known here are 0 to {len(MODELS) - 1}"
        raise ValueError(f"camera {number} has model {model}; {known}: convert it to text (colmap model_converter)")
    name = list(MODELS)[model]
    return (number, name, width, height, *_take(file, f"{MODELS[name]}d")), 0


def _image_record(file: BinaryIO) -> _Record:
    values, start = _take(file, "i7di"), file.tell()
    name, end, _ = file.read(_LONGEST).partition(b"\0")
    if not end:
        raise ValueError("a name does not end")
    file.seek(start + len(name) + 1)
    try:
        return (*values, name.decode()), 24 * _take(file, "Q")[0]  # its points, each x, y and an id
    except UnicodeDecodeError:
        raise ValueError(f"the name {str(name)[1:]} of an image is not in UTF-8") from None


def _point_record(file: BinaryIO) -> _Record:
    *values, track = _take(file, "Q3d3BdQ")
    return values, 8 * track  # pairs of an image and a point in it


def _camera(number: Any, model: str, width: Any, height: Any, *params: Any) -> Tuple[int, _Lens]:
    """Return a camera with its number, by the values of its line, or of its record."""
    width, height, params = int(width), int(height), tuple(map(float, params))
    if len(params) != MODELS.get(model, len(params)):
        raise ValueError(f"a camera of model {model} has {MODELS[model]} parameters, not {len(params)}")
    if not is_lens(width, height, params[: 2 if model == "PINHOLE" else 1], params):
        raise ValueError(f"a camera of {width}x{height} pixels with parameters {params}")
    if model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        return int(number), (model, None)
    *focal, cx, cy = params
    return int(number), (model, Camera(width, height, focal[0], focal[-1], cx, cy, np.eye(4)))


def _image(_: Any, w: Any, x: Any, y: Any, z: Any, tx: Any, ty: Any, tz: Any, camera_id: Any, name: str) -> _Image:
    """Return an image by the values of its line, or of its record."""
    parts = name.replace("\\", "/").split("/")
    if "\0" in name or ".." in parts or not parts[0] or os.path.isabs(name):
        raise ValueError(f"an image has the name {name!r}, which no file can have, or which leads out of the scene")
    quaternion, translation = (np.array(values, np.float64) for values in ((w, x, y, z), (tx, ty, tz)))
    if not (1e-150 < np.abs(quaternion).max() < 1e150 and np.abs(translation).max() < _FARTHEST_CAMERA):  # NaN is not
        raise ValueError(f"the pose of {name!r} is not a number")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(quaternion), translation
    return name, int(camera_id), pose


def _check_points(number: int, points: str) -> None:
    """Check the second line of an image: it has three numbers a point, and may be empty."""
    with suppress(ValueError):
        if len([float(word) for word in points.split()]) % 3 == 0:
            return
    raise ValueError(
        f"line {number} should have its points, X Y POINT3D_ID each: an image has two lines, and the second "
        f"may be empty, but is {points.strip()[:80]!r}"
    )


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return [3, 3] of a quaternion w, x, y, z of any length: v -> 2 u (u.v) + (w^2 - u.u) v + 2w u x v."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    u = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return 2 * np.outer(u, u) + (w * w - u @ u) * np.eye(3) + 2 * w * cross


def _point(_: Any, x: Any, y: Any, z: Any, r: Any, g: Any, b: Any, *__: Any) -> List[float]:
    return [float(x), float(y), float(z), int(r), int(g), int(b)]


def _cloud(points: List[Any]) -> PointCloud:
    """Return points of x, y, z, red, green and blue."""
    table = np.asarray(points, dtype=np.float64).reshape(-1, 6)
    positions, colours = table[:, :3], table[:, 3:]
    if not (np.abs(positions) <= np.finfo(np.float32).max).all():
        raise ValueError("a point is nowhere: its position is no number, or none that float32 can hold")
    if colours.size and (colours.min() < 0 or colours.max() > 255):
        raise ValueError("a point's colour is outside of 0..255")
    return PointCloud(positions.astype(np.float32), colours.astype(np.uint8))


# Of a model's files: what reads a record of a binary one, what checks its values or a line's, what is made of all, how
# often at most a line is split (a name may have spaces, a track may be long), and what stands in a line.
_FILES: Dict[str, Tuple[Any, ...]] = {
    "cameras": (_camera_record, _camera, dict, -1, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."),
    "images": (_image_record, _image, list, 9, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then a line of points"),
    "points3D": (_point_record, _point, _cloud, 8, "POINT3D_ID X Y Z R G B ERROR TRACK..."),
}
