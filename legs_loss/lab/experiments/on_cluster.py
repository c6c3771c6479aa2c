"""Run the trainings of a comparison on the workers of a dask scheduler, one task each."""

from __future__ import annotations

import time
from typing import Any, Callable, Dict, Sequence

from legs_loss.errors import LegsError
from legs_loss.lab.training.side_by_side import Arm, train_arm
from legs_loss.lab.training.trainer import Progress
from legs_loss.system.executors import Listener, outcomes

__all__ = ["train_on_cluster"]

_TELL_SECONDS = 0.5


def train_on_cluster(
    arms: Sequence[Arm],
    scheduler: str,
    on_progress: Callable[[str, Progress], None],
    on_done: Callable[[str, Dict[str, Any]], None],
) -> None:
    """Train arms on a cluster that shares the file system; the other arguments are those of ``train_side_by_side``.

    Their paths are absolute.
    If a worker dies, another one resumes its training from the last checkpoint.

    Raises:
        LegsError: an arm failed; the message names it and its worker. Finished trainings are kept.
    """
    for arm in arms:
        if arm.out is not None:
            arm.out.mkdir(parents=True, exist_ok=True)  # made by a worker it would be on its own disk

    def listen(message: Dict[str, Any]) -> None:
        on_progress(message["name"], Progress(*message["progress"]))

    failed: Dict[str, LegsError] = {}
    for arm, outcome in outcomes(_train, arms, scheduler, listen):
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
