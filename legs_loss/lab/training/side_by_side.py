"""Run several trainings at once, each in a process with one thread, or on a cluster: a fair and fast comparison."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path
from typing import Any, Callable, Dict, Mapping, NamedTuple, Optional, Sequence

from legs_loss.errors import LegsError
from legs_loss.lab.training.perceptual import use_lpips
from legs_loss.lab.training.trainer import Progress, TrainConfig, train
from legs_loss.precompute.executors import Listener, outcomes
from legs_loss.scenes import read_scene

_TELL_SECONDS = 0.5


class Arm(NamedTuple):
    """One training: its name, and what `train` needs. ``images`` is the folder that ``read_scene`` takes."""

    name: str
    scene: Path
    config: TrainConfig
    out: Optional[Path]
    images: Optional[str] = None
    store: Optional[Path] = None
    caps: Optional[Mapping[int, int]] = None
    evaluate_every: Optional[int] = None
    resume: Optional[bool] = False
    lpips: Optional[Path] = None  # as use_lpips takes it


def train_side_by_side(
    arms: Sequence[Arm],
    processes: int,
    on_progress: Callable[[str, Progress], None],
    on_done: Callable[[str, Dict[str, Any]], None] = lambda name, metrics: None,
    scheduler: Optional[str] = None,
) -> Dict[str, Dict[str, Any]]:
    """Train all arms, in order, ``processes`` at a time; return their metrics by name.

    Starts processes, so a script that calls it needs its ``if __name__ == "__main__"``.

    Args:
        arms: the trainings.
        processes: at a time.
        on_progress: gets a name and its progress.
        on_done: gets the name and the metrics of each as soon as it ends.
        scheduler: the address of a dask scheduler, whose workers train them, sharing the file system; paths are
            absolute then. If a worker dies, another one resumes its training from the last checkpoint.

    Raises:
        LegsError: an arm failed; the message names it. The others are ended, or, on a cluster, first trained.
    """
    metrics: Dict[str, Dict[str, Any]] = {}
    failed: Dict[str, LegsError] = {}

    def listen(message: Dict[str, Any]) -> None:
        on_progress(message["name"], Progress(*message["progress"]))

    for arm in arms if scheduler is not None else ():
        if arm.out is not None:
            arm.out.mkdir(parents=True, exist_ok=True)  # made by a worker it would be on its own disk
    work = _train if scheduler is None else _train_there
    with closing(outcomes(work, arms, listen, processes, scheduler)) as results:
        for arm, outcome in results:
            if not isinstance(outcome, LegsError):
                metrics[arm.name] = outcome
                on_done(arm.name, outcome)
                continue
            failed[arm.name] = outcome
            if scheduler is None:
                break
    for name, error in failed.items():
        raise LegsError(f"{name}: {error}")
    return {arm.name: metrics[arm.name] for arm in arms}


def train_arm(arm: Arm, on_progress: Callable[[Progress], None]) -> Dict[str, Any]:
    """Train one arm in this process, with one thread from here on; return its metrics."""
    import torch

    torch.set_num_threads(1)
    use_lpips(arm.lpips)
    return train(
        read_scene(arm.scene, arm.images),
        arm.config,
        out=arm.out,
        resume=arm.resume,
        store=arm.store,
        on_progress=on_progress,
        caps=arm.caps,
        evaluate_every=arm.evaluate_every,
    ).metrics


def _train(arm: Arm, tell: Listener) -> Dict[str, Any]:
    return train_arm(arm, lambda progress: tell({"name": arm.name, "progress": list(progress)}))


def _train_there(arm: Arm, tell: Listener) -> Dict[str, Any]:
    """Train one arm on a cluster's worker; it tells its progress a few times a second."""
    for folder, what in ((arm.scene, "the scene"), (arm.out, "the results")):
        if folder is not None and not folder.is_dir():
            raise LegsError(f"there is no folder {folder} here: is the file system with {what} mounted?")
    due = 0.0

    def seldom(message: Dict[str, Any]) -> None:
        nonlocal due
        if time.monotonic() >= due or message["progress"][0] == arm.config.iterations:
            due = time.monotonic() + _TELL_SECONDS
            tell(message)

    return _train(arm, seldom)
