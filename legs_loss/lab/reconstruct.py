"""Reconstruct a COLMAP scene from photographs by pycolmap: camera poses and points.

It runs the steps of COLMAP's own programs, and writes 3DGS's layout: undistorted photographs in images/,
pinhole cameras, poses and points in sparse/0/.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any, Callable, List, NamedTuple, Optional, Sequence, Tuple

from legs_loss.errors import LegsError, require
from legs_loss.scenes.folder import PHOTOGRAPHS, files_below, left_out
from legs_loss.scenes.images import open_image

_READ = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
FEWEST = 3  # photographs that a scene needs


class Reconstructed(NamedTuple):
    """A scene that was made.

    Attributes:
        folder: the scene.
        placed, lost: the names of the photographs whose camera was found, and of the others.
        points: the number of points.
        error: the mean reprojection error in pixels.
    """

    folder: Path
    placed: Tuple[str, ...]
    lost: Tuple[str, ...]
    points: int
    error: float


def reconstruct(
    photographs: Path,
    out: Path,
    max_size: int = 3200,
    overlap: Optional[int] = None,
    threads: int = -1,
    tell: Callable[[str], None] = lambda step: None,
) -> Reconstructed:
    """Find the cameras of photographs and points of the scene, and write them as a COLMAP scene.

    Args:
        photographs: a folder of photographs, all of one scene; folders within it are looked at too.
        out: the scene's folder, which must not exist yet. It is created when it is complete.
        max_size: pixels of the longer side: features are looked for, and photographs written, at this size at most.
        overlap: compare each photograph with so many that follow it by name, for frames of a video; None compares all
            with all.
        threads: -1 for one a core.
        tell: called with a line for each step as it begins, and one for what is left out.

    Raises:
        LegsError: pycolmap is missing, there are too few photographs, or no scene can be made of them.
    """
    pycolmap = _pycolmap()
    names, left = _photographs(photographs)
    if left:
        tell(f"legs: note: {left_out(left)}")
    if out.exists():
        raise LegsError(f"{out} exists already: choose another folder, or remove it")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.part-", dir=str(out.parent)) as folder:
            work = Path(folder)
            database = work / "database.db"
            tell(f"features of {len(names)} photographs ...")
            _extract(pycolmap, database, photographs, names, max_size, threads)
            tell("features that photographs share ...")
            _match(pycolmap, database, overlap, threads)
            tell("cameras and points ...")
            model = _map(pycolmap, database, photographs, work / "models", threads)
            tell("undistorted photographs ...")
            scene = _undistort(pycolmap, model, photographs, work, max_size, threads)
            placed = sorted(image.name for image in model.images.values() if image.has_pose)
            os.replace(str(scene), str(out))
    except OSError as error:
        why = "made by another meanwhile" if out.exists() else error.strerror or error
        raise LegsError(f"cannot write {out}: {why}") from None
    lost = tuple(sorted(set(names) - set(placed)))
    return Reconstructed(out, tuple(placed), lost, len(model.points3D), float(model.compute_mean_reprojection_error()))


def _pycolmap() -> Any:
    require("reconstruction", "colmap", "pycolmap")
    import pycolmap

    if not hasattr(pycolmap, "FeatureMatchingOptions"):
        raise LegsError("this pycolmap is too old: pip install --upgrade pycolmap")
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # failures are reported by this module
    pycolmap.set_random_seed(0)
    return pycolmap


def _photographs(folder: Path) -> Tuple[List[str], List[str]]:
    """Return the names of the photographs in a folder and below, and of those in formats that COLMAP does not read."""
    if not folder.is_dir():
        raise LegsError(f"there is no folder {folder}: give the folder of the photographs")
    found = sorted(path.relative_to(folder).as_posix() for path in files_below(folder, PHOTOGRAPHS))
    names = [name for name in found if name.lower().endswith(_READ)]
    left = [name for name in found if name not in names]
    if len(names) < FEWEST:
        known = f"{folder}: {len(names)} photographs ({', '.join(_READ)}); at least {FEWEST} are needed"
        raise LegsError(f"{known}; {left_out(left)}" if left else known)
    return names, left


def _one_camera(folder: Path, names: Sequence[str]) -> bool:
    """Return whether all photographs have one size, and one focal length as far as they tell it."""
    kinds = set()
    for name in names:
        with open_image(folder / name) as photograph:
            exif = photograph.getexif()
            kinds.add((photograph.size, exif.get_ifd(0x8769).get(0x920A) if exif else None))
    return len(kinds) == 1


def _extract(pycolmap: Any, database: Path, folder: Path, names: Sequence[str], max_size: int, threads: int) -> None:
    mode = pycolmap.CameraMode.SINGLE if _one_camera(folder, names) else pycolmap.CameraMode.AUTO
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads = max_size, threads
    pycolmap.extract_features(database, folder, list(names), mode, extraction_options=options)


def _match(pycolmap: Any, database: Path, overlap: Optional[int], threads: int) -> None:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = threads
    if overlap is None:
        pycolmap.match_exhaustive(database, options)
        return
    pairs = pycolmap.SequentialPairingOptions()
    pairs.overlap, pairs.quadratic_overlap = overlap, False
    pycolmap.match_sequential(database, options, pairs)


def _map(pycolmap: Any, database: Path, folder: Path, out: Path, threads: int) -> Any:
    out.mkdir()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed, options.min_model_size = threads, 0, FEWEST
    models = pycolmap.incremental_mapping(database, folder, out, options)
    if not models:
        raise LegsError(
            f"{folder}: no scene can be made of these photographs. They must show one still scene from different "
            "places, each overlapping its neighbours by half or more, with texture, in focus"
        )
    return max(models.values(), key=lambda model: model.num_reg_images())


def _undistort(pycolmap: Any, model: Any, folder: Path, work: Path, max_size: int, threads: int) -> Path:
    best, made = work / "best", work / "undistorted"
    best.mkdir()
    model.write(best)
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max_size
    pycolmap.undistort_images(made, best, folder, undistort_options=options, jpeg_quality=95, num_threads=threads)
    scene = work / "scene"
    (scene / "sparse").mkdir(parents=True)
    os.replace(str(made / "images"), str(scene / "images"))
    os.replace(str(made / "sparse"), str(scene / "sparse" / "0"))
    return scene
