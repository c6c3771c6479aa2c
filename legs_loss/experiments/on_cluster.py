"""Run the trainings of a comparison on the workers of a dask scheduler, one task each."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any, Callable, Dict, Sequence

from legs_loss.errors import LegsError
from legs_loss.reference.training.side_by_side import Arm, train_arm
from legs_loss.reference.training.trainer import Progress
from legs_loss.system.executors import Listener, executor, in_the_order_they_end

__all__ = ["train_on_cluster"]

_TELL_SECONDS = 0.5


def train_on_cluster(
    arms: Sequence[Arm],
    scheduler: str,
    on_progress: Callable[[str, Progress], None],
    on_done: Callable[[str, Dict[str, Any]], None],
) -> None:
    """Train all arms on a cluster that shares the file system; the other arguments are those of ``train_side_by_side``.

    If a worker dies, another one resumes its training from the last checkpoint.

    Raises:
        LegsError: an arm failed; the message names it and its worker. Finished trainings are kept.
    """
    if not arms:
        return
    absolute = [
        arm._replace(
            scene=Path(os.path.abspath(str(arm.scene))),
            out=None if arm.out is None else Path(os.path.abspath(str(arm.out))),
            images=os.path.abspath(arm.images) if arm.images and os.path.isdir(arm.images) else arm.images,
        )
        for arm in arms
    ]

    def listen(message: Dict[str, Any]) -> None:
        on_progress(message["name"], Progress(*message["progress"]))

    failed: Dict[str, LegsError] = {}
    with executor(scheduler, listen) as (runs, tell):
        for arm, outcome in in_the_order_they_end(runs, _train, absolute, tell):
            if isinstance(outcome, LegsError):
                failed[arm.name] = outcome
            else:
                on_done(arm.name, outcome)
    for name, error in failed.items():
        raise LegsError(f"{name}: {error}")


def _train(arm: Arm, tell: Listener) -> Dict[str, Any]:
    """Train one arm on a worker."""
    if not arm.scene.is_dir():
        raise LegsError(f"there is no folder {arm.scene} here: is the file system with the scene mounted?")
    if arm.out is not None and not arm.out.is_dir():
        raise LegsError(f"there is no folder {arm.out} here: is the file system for the results mounted?")
    due = 0.0

    def on_progress(progress: Progress) -> None:
        nonlocal due
        if time.monotonic() >= due or progress.iteration == arm.config.iterations:
            due = time.monotonic() + _TELL_SECONDS
            tell({"name": arm.name, "progress": list(progress)})

    return train_arm(arm, on_progress)
