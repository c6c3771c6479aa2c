"""Run several trainings at once, each in a separate process with one thread: a fair and fast comparison."""

from __future__ import annotations

import multiprocessing
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence

from legs_loss.errors import LegsError
from legs_loss.reference.training.trainer import Progress, TrainConfig, train
from legs_loss.scenes import read_scene
from legs_loss.system import kept_from_children

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
    running: Dict[Any, _Process] = {}  # by this side's end of their pipes
    metrics: Dict[str, Dict[str, Any]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                process = _Process(waiting.pop())
                running[process.connection] = process
            ready: List[Any] = wait(list(running))
            for connection in ready:
                name = running[connection].name
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
                running.pop(connection).end()
                if on_done is not None:
                    on_done(name, message)
    finally:
        for process in running.values():
            process.end()
    return {arm.name: metrics[arm.name] for arm in arms}


class _Process:
    def __init__(self, arm: Arm) -> None:
        self.name = arm.name
        context = multiprocessing.get_context("spawn")  # forked, it would inherit locks and threads
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_work, args=(theirs, arm), daemon=True)
        with kept_from_children():
            self.process.start()
        theirs.close()

    def end(self) -> None:
        self.connection.close()
        self.process.terminate()
        self.process.join()


def train_arm(arm: Arm, on_progress: Callable[[Progress], None]) -> Dict[str, Any]:
    """Train one arm in this process, with one thread from here on; return its metrics."""
    import numba
    import torch

    torch.set_num_threads(1)
    numba.set_num_threads(1)
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
