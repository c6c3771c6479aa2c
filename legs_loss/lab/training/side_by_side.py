"""Run several trainings at once, each in a separate process with one thread: a fair and fast comparison."""

from __future__ import annotations

from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple

from legs_loss.errors import LegsError
from legs_loss.lab.training.perceptual import use_lpips
from legs_loss.lab.training.trainer import Progress, TrainConfig, train
from legs_loss.scenes import read_scene
from legs_loss.system import Child

__all__ = ["Arm", "train_arm", "train_side_by_side"]


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
    on_done: Optional[Callable[[str, Dict[str, Any]], None]] = None,
) -> Dict[str, Dict[str, Any]]:
    """Train all arms, in order, ``processes`` at a time; return their metrics by name.

    ``on_done`` gets the name and the metrics of each as soon as it ends.

    Uses fresh processes, so a script that calls it needs its ``if __name__ == "__main__"``.

    Raises:
        LegsError: an arm failed; the message names it. The others are ended.
    """
    waiting: List[Arm] = list(reversed(arms))
    running: Dict[Any, Tuple[str, Child]] = {}  # by this side's end of their pipes
    metrics: Dict[str, Dict[str, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                arm = waiting.pop()
                child = Child(_work, arm)
                running[child.connection] = arm.name, child
            ready: List[Any] = wait(list(running))
            for connection in ready:
                name, child = running[connection]
                try:
                    message = connection.recv()
                except (EOFError, OSError):
                    raise LegsError(f"{name}: its process was killed (out of memory?)") from None
                if isinstance(message, Progress):
                    on_progress(name, message)
                    continue
                if isinstance(message, str):
                    raise LegsError(f"{name}: {message}")
                metrics[name] = message
                del running[connection]
                child.end()
                if on_done is not None:
                    on_done(name, message)
    finally:
        for _, child in running.values():
            child.end()
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


def _work(connection: Connection, arm: Arm) -> None:
    try:
        try:
            connection.send(train_arm(arm, connection.send))
        except (LegsError, OSError) as error:  # a full disk is no fault of the code either
            connection.send(str(error))
    except OSError:
        pass  # the parent was killed: the training resumes from its files
