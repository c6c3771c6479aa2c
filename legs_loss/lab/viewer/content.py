"""Read the content of a folder or a .ply: the Gaussians of each method, and the scene that they were trained on."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Dict, Iterator, NamedTuple, Optional, Tuple

from legs_loss.errors import LegsError
from legs_loss.scenes import Scene, read_scene


class Content(NamedTuple):
    """The .ply of each method by its name; the scene, where it is known; 3DGS's ``-r`` of its photographs."""

    title: str
    methods: Dict[str, Path]
    scene: Optional[Scene]
    resolution: int


def find_content(path: Path, scene: Optional[Path] = None) -> Content:
    """Return the content of a path.

    Args:
        path: a .ply of 3DGS; the output folder of a training (``legs train``, 3DGS and its forks); a folder of several
            such, as ``legs demo`` writes; or a comparison.
        scene: where the photographs lie; a comparison knows it, and ``legs demo`` leaves its own beside the runs.

    Raises:
        LegsError: there are no Gaussians in it.
    """
    if not path.exists():
        raise LegsError(f"there is no file or folder {path}: give a .ply, a run's folder or a comparison")
    if (path / "comparison.json").is_file():
        return _comparison(path, scene)
    methods = {path.stem: path} if path.is_file() else dict(_runs(path))
    if not methods:
        raise LegsError(f"{path} holds no Gaussians: a run has point_cloud/iteration_N/point_cloud.ply")
    beside = path / "scene" if scene is None and (path / "scene" / "sparse").is_dir() else scene
    return Content(path.resolve().name, methods, None if beside is None else read_scene(beside), -1)


def _runs(path: Path) -> Iterator[Tuple[str, Path]]:
    """Return the folder's own last .ply, or those of the folders in it."""
    last = _last(path)
    if last is not None:
        yield path.resolve().name, last
        return
    for folder in sorted(path.iterdir()):
        found = _last(folder)
        if found is not None:
            yield folder.name, found


def _last(run: Path) -> Optional[Path]:
    found = list(run.glob("point_cloud/iteration_*/point_cloud.ply"))
    return max(found, key=lambda path: int(re.sub(r"\D", "", path.parent.name) or 0), default=None)


def _comparison(path: Path, moved: Optional[Path]) -> Content:
    from legs_loss.lab.experiments.arms import parse_arm
    from legs_loss.lab.experiments.running import read_rows, scene_of
    from legs_loss.lab.training.trainer import TrainConfig

    settings, rows = read_rows(path)
    methods: Dict[str, Path] = {}
    for row in sorted(rows, key=lambda row: row["seed"]):  # the first seed of each arm
        found = _last(path / parse_arm(row["arm"]).folder / f"seed-{row['seed']}")
        if found is not None:
            methods.setdefault(row["arm"], found)
    if not methods:
        raise LegsError(f"{path}: the rows of this comparison have no point_cloud.ply any more")
    scene = None
    with suppress(LegsError):  # the Gaussians can be seen without it
        scene = scene_of(settings, moved)
    if scene is None and moved is not None:
        scene = scene_of(settings, moved)
    return Content(path.resolve().name, methods, scene, TrainConfig.from_dict(settings["base"]).resolution)
