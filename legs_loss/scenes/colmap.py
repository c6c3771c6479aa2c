"""COLMAP's sparse model, binary or text: https://colmap.github.io/format.html."""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Callable, Dict, Iterator, List, NamedTuple, Optional, Tuple

import numpy as np

from legs_loss.errors import LegsError
from legs_loss.scenes.model import Camera, PointCloud, Scene, View
from legs_loss.system import open_regular, read_text

__all__ = ["find_model", "read_colmap", "read_points"]

# COLMAP's camera models in the order of their ids, each with its number of parameters and of focal lengths among them,
# which come first.
MODELS = {
    "SIMPLE_PINHOLE": (3, 1),
    "PINHOLE": (4, 2),
    "SIMPLE_RADIAL": (4, 1),
    "RADIAL": (5, 1),
    "OPENCV": (8, 2),
    "OPENCV_FISHEYE": (8, 2),
    "FULL_OPENCV": (12, 2),
    "FOV": (5, 2),
    "SIMPLE_RADIAL_FISHEYE": (4, 1),
    "RADIAL_FISHEYE": (5, 1),
    "THIN_PRISM_FISHEYE": (12, 2),
    "RAD_TAN_THIN_PRISM_FISHEYE": (16, 2),
    "SIMPLE_DIVISION": (4, 1),
    "DIVISION": (5, 2),
    "SIMPLE_FISHEYE": (3, 1),
    "FISHEYE": (4, 2),
    "EUCM": (6, 2),
    "EQUIRECTANGULAR": (2, 0),
}

_CAMERA_LINE = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS..."
_IMAGE_LINE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_POINT_LINE = "POINT3D_ID X Y Z R G B ERROR TRACK..."
_LARGEST = 2 << 30  # bytes of a text, which is read whole; of a binary file as much is read as its counts say
_LONGEST = 4096  # bytes of an image's name
_SIDE = 1 << 20  # pixels
_LONGEST_FOCAL, _FARTHEST_CAMERA = 1e9, 1e12  # pixels, and the scene's unit: what float32 can still compute with
_FARTHEST = float(np.finfo(np.float32).max)


class _Intrinsics(NamedTuple):
    model: str
    width: int
    height: int
    params: Tuple[float, ...]


class _Image(NamedTuple):
    name: str
    camera_id: int
    quaternion: Tuple[float, ...]  # w, x, y, z: turns world axes into camera axes
    translation: Tuple[float, ...]


def find_model(root: Path) -> Optional[Path]:
    """Return the folder of a scene's sparse model, ``sparse/0`` or else ``sparse``; None without one."""
    for folder in (root / "sparse" / "0", root / "sparse"):
        if (folder / "images.bin").is_file() or (folder / "images.txt").is_file():
            return folder
    return None


def read_colmap(root: Path, images: Path, prefix: str) -> Scene:
    """Read a scene in COLMAP's layout, its photographs from the folder ``images``.

    A photograph is looked for under its whole COLMAP name and then, as 3DGS does, under the last
    part of it; ``prefix`` goes before its name in :class:`View`. Cameras other than PINHOLE and
    SIMPLE_PINHOLE leave ``View.camera`` None. Raises :class:`LegsError` when the model is damaged.
    """
    model = find_model(root)
    if model is None:
        raise LegsError(f"{root} has no COLMAP model: there is no sparse/0/images.bin or .txt")
    kind = "bin" if (model / "images.bin").is_file() else "txt"
    cameras = _parse(model / f"cameras.{kind}", _cameras_bin if kind == "bin" else _cameras_txt)
    entries, kind = _entries(model)
    views = []
    for image in entries:
        if image.camera_id not in cameras:
            raise LegsError(
                f"{model / f'images.{kind}'}: {image.name!r} has camera {image.camera_id}, "
                f"which cameras.{kind} does not list"
            )
        name = image.name.replace("\\", "/")
        path = images / name
        if not os.path.isfile(str(path)) and os.path.isfile(str(images / path.name)):  # pathlib's raise for some names
            path, name = images / path.name, path.name
        lens = cameras[image.camera_id]
        views.append(View(f"{prefix}{name}", path, _pinhole(lens, image), camera_model=lens.model))
    points = model / f"points3D.{kind}"
    read = partial(read_points, points) if points.is_file() else None
    views.sort(key=lambda view: view.name)
    return Scene(root, "colmap", tuple(views), read, notes=_larger_models(root, model, len(views)))


def _entries(model: Path) -> Tuple[List[_Image], str]:
    """Return the images that a model lists, and the kind of its files, bin or txt."""
    kind = "bin" if (model / "images.bin").is_file() else "txt"
    return _parse(model / f"images.{kind}", _images_bin if kind == "bin" else _images_txt), kind


def _larger_models(root: Path, model: Path, count: int) -> Tuple[str, ...]:
    """Return a note where another of the models that COLMAP made has more images than the one that is read."""
    sizes = {}
    for folder in sorted((root / "sparse").iterdir()):
        if folder.name.isdigit() and folder != model:
            with suppress(LegsError):
                sizes[folder.name] = len(_entries(folder)[0])
    name = max(sizes, key=lambda name: sizes[name], default="")
    if sizes.get(name, 0) <= count:
        return ()
    return (
        f"COLMAP made several models: {root / 'sparse' / name} has {sizes[name]} images, and {model.name}, which is "
        f"read here as 3DGS does, has {count}; to use the larger one, rename it to 0",
    )


def read_points(path: Path) -> PointCloud:
    """Read a points3D.bin or points3D.txt. Raises :class:`LegsError` when it is damaged."""
    return _parse(path, _points_bin if path.suffix == ".bin" else _points_txt)


def _parse(path: Path, parser: Callable[[Any], Any]) -> Any:
    try:
        if path.suffix == ".txt":
            return parser(read_text(path, _LARGEST))
        with open_regular(path) as file:
            return parser(file)
    except OSError as error:
        raise LegsError(f"cannot read {path}: {error.strerror}") from None
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise LegsError(f"{path} is not as COLMAP writes it: {error}") from None


def _pinhole(lens: _Intrinsics, image: _Image) -> Optional[Camera]:
    if lens.model == "PINHOLE":
        fx, fy, cx, cy = lens.params
    elif lens.model == "SIMPLE_PINHOLE":
        fx, cx, cy = lens.params
        fy = fx
    else:
        return None
    pose = np.eye(4)
    pose[:3, :3] = _rotation(image.quaternion)
    pose[:3, 3] = image.translation
    return Camera(lens.width, lens.height, fx, fy, cx, cy, pose)


def _rotation(quaternion: Tuple[float, ...]) -> np.ndarray:
    """Return [3, 3] of a quaternion w, x, y, z of any length: v -> 2 u (u.v) + (w^2 - u.u) v + 2w u x v."""
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    u = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return 2 * np.outer(u, u) + (w * w - u @ u) * np.eye(3) + 2 * w * cross


class _Cursor:
    """Reads a binary file from front to back; the end of the file must be the end of the data."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.size = file, os.fstat(file.fileno()).st_size

    def take(self, layout: str) -> Tuple[Any, ...]:
        return struct.unpack(f"<{layout}", self.file.read(struct.calcsize(f"<{layout}")))

    def name(self) -> str:
        name = bytearray()
        while name[-1:] != b"\0":
            letter = self.file.read(1)
            if not letter or len(name) > _LONGEST:
                raise ValueError("a name does not end")
            name += letter
        try:
            return name[:-1].decode()
        except UnicodeDecodeError:
            raise ValueError(f"the name {str(bytes(name[:-1]))[1:]} of an image is not in UTF-8") from None

    def skip(self, size: int) -> None:
        left = self.size - self.file.tell()
        if size > left:
            raise ValueError(f"it ends {size - left} bytes too early")
        self.file.seek(size, os.SEEK_CUR)

    def finish(self) -> None:
        if self.file.tell() != self.size:
            raise ValueError(f"{self.size} bytes where its own counts say {self.file.tell()}")


def _cameras_bin(file: BinaryIO) -> Dict[int, _Intrinsics]:
    cursor, cameras = _Cursor(file), {}
    for _ in range(cursor.take("Q")[0]):
        number, model, width, height = cursor.take("iiQQ")
        if not 0 <= model < len(MODELS):
            known = f"known here are 0 to {len(MODELS) - 1}"
            raise ValueError(f"camera {number} has model {model}; {known}: convert it to text (colmap model_converter)")
        name = list(MODELS)[model]
        cameras[number] = _intrinsics(name, width, height, cursor.take(f"{MODELS[name][0]}d"))
    cursor.finish()
    return cameras


def _images_bin(file: BinaryIO) -> List[_Image]:
    cursor, images = _Cursor(file), []
    for _ in range(cursor.take("Q")[0]):
        pose = cursor.take("i7d")
        (camera,) = cursor.take("i")
        images.append(_image(cursor.name(), camera, pose[1:5], pose[5:8]))
        cursor.skip(24 * cursor.take("Q")[0])  # the image's points, each x, y and an id
    cursor.finish()
    return images


def _points_bin(file: BinaryIO) -> PointCloud:
    cursor, xyz, rgb = _Cursor(file), [], []
    for _ in range(cursor.take("Q")[0]):
        point = cursor.take("Q3d3BdQ")
        xyz.append(point[1:4])
        rgb.append(point[4:7])
        cursor.skip(8 * point[8])  # the track: pairs of an image and a point in it
    cursor.finish()
    return _cloud(xyz, rgb)


Lines = Iterator[Tuple[int, str]]  # with their numbers


def _rows(text: str, layout: str, read: Callable[[str, Lines], Any]) -> List[Any]:
    """Return what is read of the lines that are no comments and not empty; ``read`` may take further ones."""
    lines = ((n, line) for n, line in enumerate(text.split("\n"), 1) if not line.startswith("#"))
    rows = []
    for number, line in lines:
        if line.strip():
            try:
                rows.append(read(line, lines))
            except (ValueError, IndexError) as error:
                why = "too few values" if isinstance(error, IndexError) else error
                raise ValueError(f"line {number}, {line.strip()[:80]!r}: {why} (expected: {layout})") from None
    return rows


def _cameras_txt(text: str) -> Dict[int, _Intrinsics]:
    def camera(line: str, _: Lines) -> Tuple[int, _Intrinsics]:
        words = line.split()
        params = tuple(float(word) for word in words[4:])
        return int(words[0]), _intrinsics(words[1], int(words[2]), int(words[3]), params)

    return dict(_rows(text, _CAMERA_LINE, camera))


def _images_txt(text: str) -> List[_Image]:
    def image(line: str, lines: Lines) -> _Image:
        words = line.split(None, 9)  # the name comes last and may have spaces
        numbers = tuple(float(word) for word in words[1:8])
        found = _image(words[9].rstrip(), int(words[8]), numbers[:4], numbers[4:])
        number, points = next(lines, (0, ""))
        if not _are_points(points.split()):
            raise ValueError(
                f"line {number} should have its points, X Y POINT3D_ID each: an image has two lines, and the second "
                f"may be empty, but is {points.strip()[:80]!r}"
            )
        return found

    return _rows(text, f"{_IMAGE_LINE}, then a line of points", image)


def _are_points(words: List[str]) -> bool:
    try:
        return len([float(word) for word in words]) % 3 == 0
    except ValueError:
        return False


def _points_txt(text: str) -> PointCloud:
    def point(line: str, _: Lines) -> Tuple[List[float], List[int]]:
        words = line.split(None, 7)
        return [float(word) for word in words[1:4]], [int(word) for word in words[4:7]]

    rows = _rows(text, _POINT_LINE, point)
    return _cloud([xyz for xyz, _ in rows], [rgb for _, rgb in rows])


def _intrinsics(model: str, width: int, height: int, params: Tuple[float, ...]) -> _Intrinsics:
    count, focal_lengths = MODELS.get(model, (len(params), 0))
    if len(params) != count:
        raise ValueError(f"a camera of model {model} has {len(params)} parameters")
    focal = params[:focal_lengths]
    if not (
        0 < width <= _SIDE and 0 < height <= _SIDE and _is_within(params, _LONGEST_FOCAL) and min(focal, default=1) > 0
    ):
        raise ValueError(f"a camera of {width}x{height} pixels with parameters {params}")
    return _Intrinsics(model, width, height, params)


def _image(name: str, camera_id: int, quaternion: Tuple[float, ...], translation: Tuple[float, ...]) -> _Image:
    if not name or "\0" in name:
        raise ValueError(f"an image has the name {name!r}, which no file can have")
    parts = name.replace("\\", "/").split("/")
    if ".." in parts or not parts[0] or os.path.isabs(name):
        raise ValueError(f"an image has the name {name!r}, which leads out of the scene")
    if len(quaternion) != 4 or len(translation) != 3:
        raise ValueError(f"the pose of {name!r} has {len(quaternion) + len(translation)} numbers, not 7")
    largest = max(map(abs, quaternion))
    if not (1e-150 < largest < 1e150 and _is_within(quaternion, 1e150) and _is_within(translation, _FARTHEST_CAMERA)):
        raise ValueError(f"the pose of {name!r} is not a number")
    return _Image(name, camera_id, quaternion, translation)


def _is_within(values: Tuple[float, ...], limit: float) -> bool:
    return all(abs(value) < limit for value in values)  # of NaN, too, this is false


def _cloud(xyz: List[Any], rgb: List[Any]) -> PointCloud:
    positions = np.asarray(xyz, dtype=np.float64).reshape(-1, 3)
    colours = np.asarray(rgb).reshape(-1, 3)
    if len(positions) != len(colours) or not (np.abs(positions) <= _FARTHEST).all():
        raise ValueError("a point is nowhere: its position is no number, or none that float32 can hold")
    if colours.size and (colours.min() < 0 or colours.max() > 255):
        raise ValueError("a point's colour is outside of 0..255")
    return PointCloud(positions.astype(np.float32), colours.astype(np.uint8))
