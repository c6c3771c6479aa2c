"""Weight maps of many scenes: one task for each, here or on a cluster with a shared file system."""

from __future__ import annotations

import glob
import os
import time
from collections import Counter
from pathlib import Path
from typing import List, NamedTuple, Optional, Sequence, Tuple

from legs_loss.config import STORE_FOLDER
from legs_loss.errors import LegsError
from legs_loss.precompute import Report, UserMaps, precompute
from legs_loss.precompute.executors import Listener
from legs_loss.scenes import read_scene
from legs_loss.spec import Spec
from legs_loss.system.files import read_text

_TELL_SECONDS = 0.25
_LARGEST = 64 << 20  # bytes of a list


class SceneTask(NamedTuple):
    """A scene, and :func:`~legs_loss.precompute.precompute`'s arguments; paths are absolute, the same everywhere.

    ``settings`` are the spec, the resolution, whether the background is white, and the number of processes.
    """

    scene: Path
    store: Path
    images: Optional[str]
    maps: UserMaps
    settings: Tuple[Spec, int, bool, int]


def find_scenes(given: Sequence[str], lists: Sequence[Path] = ()) -> List[Path]:
    """Return the scenes of folders, glob patterns, and .txt files with one of these per line, each once.

    Relative lines of a file are relative to the file. Empty lines and lines that begin with # say nothing.

    Args:
        given: as a user names them.
        lists: the files in which these names stand.

    Raises:
        LegsError: a pattern or a file means no scene, or a scene is not there.
    """
    found: List[Path] = []
    for one in given:
        path = Path(one)
        if path.suffix == ".txt" and path.is_file():
            if path.resolve() in lists:
                raise LegsError(f"{path} is a list that names itself")
            found += find_scenes(_listed(path), [*lists, path.resolve()])
        elif path.exists() or not glob.has_magic(one):
            found.append(path)
        else:
            matches = sorted(Path(match) for match in glob.glob(one, recursive=True) if os.path.isdir(match))
            if not matches:
                raise LegsError(f"no folder matches {one}")
            found += matches
    return list(dict.fromkeys(found))


def _listed(path: Path) -> List[str]:
    try:
        lines = [line.strip() for line in read_text(path, _LARGEST).splitlines()]
    except (OSError, ValueError) as error:
        raise LegsError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    scenes = [str(path.parent / line) for line in lines if line and not line.startswith("#")]
    if not scenes:
        raise LegsError(f"{path} names no scene: it should have one folder per line")
    return scenes


def stores_of(scenes: Sequence[Path], out: Optional[str]) -> List[Path]:
    """Return where each scene's store goes: into the scene, or to ``out`` for one scene and ``out/NAME`` for several.

    Raises:
        LegsError: two scenes would have the same store.
    """
    if out is None:
        return [scene / STORE_FOLDER for scene in scenes]
    if len(scenes) == 1:
        return [Path(out)]
    names = [scene.resolve().name for scene in scenes]
    name, count = Counter(names).most_common(1)[0]
    if count > 1:
        raise LegsError(f"--out {out}: {count} scenes have the name {name}: leave out --out for them")
    return [Path(out) / name for name in names]


def precompute_scene(task: SceneTask, tell: Listener) -> Report:
    """Precompute a scene, and tell ``{"scene": path, "done": views, "of": views}`` a few times a second.

    Raises:
        LegsError: as :func:`~legs_loss.precompute.precompute`, or this machine does not see the scene.
    """
    for folder, what in ((task.scene, "scenes"), (task.store.parent, "stores")):  # made here it would be on an own disk
        if not folder.is_dir():
            raise LegsError(f"there is no folder {folder} here: is the file system with the {what} mounted?")
    scene = read_scene(task.scene, task.images)
    due = 0.0

    def on_progress(done: int, of: int) -> None:
        nonlocal due
        if time.monotonic() >= due or done == of:
            due = time.monotonic() + _TELL_SECONDS
            tell({"scene": str(task.scene), "done": done, "of": of})

    return precompute(scene, task.store, *task.settings, on_progress=on_progress, maps=task.maps)
