"""Write the normalised response of every view of a scene to its store."""

from __future__ import annotations

import os
import time
from collections import Counter, defaultdict
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Callable, Dict, Iterator, List, Optional, Union

import numpy as np

from legs_loss.config import STORE_FOLDER
from legs_loss.errors import LegsError
from legs_loss.precompute.executors import outcomes
from legs_loss.precompute.one_view import UnwritableError, make
from legs_loss.precompute.origin import note_scene
from legs_loss.precompute.photograph import response_map
from legs_loss.precompute.user_maps import NO_MAPS, UserMaps, is_below, stage_user_maps
from legs_loss.scenes import Scene, image_size, training_size
from legs_loss.spec import Spec, as_spec
from legs_loss.store import Entry, StoreWriter
from legs_loss.system.ctrl_c import held_back

_COMMIT_SECONDS = 1.0


@dataclass
class Report:
    """The result of :func:`precompute`, by names of views: maps made, maps kept, views skipped with the reason.

    ``user_maps`` are the numbers of the user's own maps, a kind each; ``notes`` are sentences for the user.
    """

    store: Path
    made: List[str] = field(default_factory=list)
    kept: List[str] = field(default_factory=list)
    skipped: Dict[str, str] = field(default_factory=dict)
    user_maps: Dict[str, int] = field(default_factory=dict)
    notes: List[str] = field(default_factory=list)


def precompute(
    scene: Scene,
    out: Union[str, Path, None] = None,
    spec: Spec = "legs",
    resolution: int = -1,
    white_background: bool = False,
    workers: int = 1,
    on_progress: Optional[Callable[[int, int], None]] = None,
    maps: UserMaps = NO_MAPS,
) -> Report:
    """Write the normalised response of every view of a scene to a store, and the user's own masks and weights.

    Args:
        scene: from :func:`~legs_loss.scenes.read_scene`.
        out: the store's folder, ``legs_weights`` in the scene by default, where a training script finds it.
            Existing maps are kept: one store holds many sizes and operators.
        spec: its operator, p, eps and smooth are used, and where it normalises over the scene its percentile; every
            curve, beta and noise floor can be made from the result.
        resolution: 3DGS's ``-r``, as for the training.
        white_background: 3DGS's ``-w``, likewise.
        workers: processes; 1 computes in this one. With more, a script needs its ``if __name__ == "__main__"``.
        on_progress: called after each view with the number of views that are done, and of all.
        maps: the user's masks and weights, of which all are checked before any is written.

    Returns:
        The maps that were made, kept and skipped. A photograph that cannot be read is skipped, not raised.

    Raises:
        LegsError: the store cannot be written or is damaged; bad settings; a mask or a map that cannot be used.
    """
    default = scene.root / STORE_FOLDER
    out = default if out is None else Path(out)
    if out.is_symlink() and os.path.abspath(str(out)) == os.path.abspath(str(default)):  # the scene's, not the user's
        raise LegsError(f"{out} is a link, which is not followed: name the folder behind it with --out")
    spec = as_spec(spec)
    training_size(1 << 20, 1 << 20, resolution)  # a bad resolution is one error, not one a view
    report = Report(out)
    views = [view for view in scene.views if not is_below(view.path, scene.root, maps)]
    with StoreWriter(out) as writer:
        mine, notes = stage_user_maps(scene.root, views, resolution, maps, writer.entries(), writer.staging)
        if mine:  # all at once, before any response: what is found in the store is never without its mask
            writer.commit(mine, [entry for entry in writer.entries() if entry.is_users])
        report.user_maps = Counter(entry.operator for entry in mine)
        report.notes += [*scene.notes, *notes, *_shared_names(scene)]
        known: Dict[str, List[Entry]] = defaultdict(list)
        for entry in writer.entries():
            known[entry.view].append(entry)
        tasks = [(view, known[view.name]) for view in views]
        if workers > 1 and any(not entries for _, entries in tasks):
            with suppress(LegsError):  # a photograph that cannot be read is skipped later, with the reason
                width, height = training_size(*image_size(views[0].path), resolution)
                response_map(np.zeros((height, width, 3), np.uint8), spec)  # compiled once, not in each process
        work = partial(make, spec, resolution, white_background, out, writer.staging)
        results = outcomes(work, tasks, print, workers if workers > 1 else 0)
        staged: List[Entry] = []
        due = time.monotonic()  # the first at once, so that there is a store
        with closing(results):
            try:
                for done, ((view, _), result) in enumerate(results, 1):
                    if isinstance(result, UnwritableError):
                        raise LegsError(f"cannot write to {out}: {result}")
                    if isinstance(result, LegsError):
                        report.skipped[view.name] = str(result)
                    elif result is None:
                        report.kept.append(view.name)
                    else:
                        report.made.append(view.name)
                        staged.append(result)
                    if on_progress is not None:
                        on_progress(done, len(tasks))
                    if staged and time.monotonic() >= due:
                        began = time.monotonic()
                        _commit(writer, staged)  # it lists all maps anew: of 100,000 for longer than a second
                        due = time.monotonic() + max(_COMMIT_SECONDS, 10 * (time.monotonic() - began))
            finally:
                _commit(writer, staged)
    if out.is_dir() and out.resolve().parent != scene.root.resolve():
        note_scene(out, scene)
    return report


def _shared_names(scene: Scene) -> Iterator[str]:
    """Yield a note where views have one name in 3DGS."""
    views = Counter(PurePosixPath(view.name).name.split(".")[0] for view in scene.views)
    alike = sum(count for count in views.values() if count > 1)
    if alike:
        yield (
            f"{alike} views share a name in 3DGS, which drops folders and extensions; codebases that use these names "
            "compute their weights instead"
        )


def _commit(writer: StoreWriter, staged: List[Entry]) -> None:
    """Commit what is staged, and empty the list; an interrupt waits until that is done."""
    with held_back():
        batch, staged[:] = list(staged), []
        if batch:
            writer.commit(batch)
