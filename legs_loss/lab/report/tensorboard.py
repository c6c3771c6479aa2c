"""Log trainings to TensorBoard: loss, PSNR and the number of Gaussians by iterations."""

from __future__ import annotations

import re
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, Optional

from legs_loss.errors import LegsError, require

if TYPE_CHECKING:
    from legs_loss.lab.training.trainer import Progress


@contextmanager
def tensorboard_log(folder: Optional[Path]) -> Iterator[Callable[[str, Progress], None]]:
    """Yield what takes a training's name and its progress; each name is a run of its own below the folder.

    Args:
        folder: None logs nothing.

    Raises:
        LegsError: TensorBoard is missing, or the folder cannot be written.
    """
    if folder is None:
        yield lambda name, progress: None
        return
    require("--tensorboard", "tensorboard", "tensorboard")
    from torch.utils.tensorboard import SummaryWriter

    writers: Dict[str, Any] = {}

    def log(name: str, progress: Progress) -> None:
        if name not in writers:
            run = re.sub(r"[^\w.@=-]+", "-", name)
            try:
                writers[name] = SummaryWriter(str(folder / run))
            except OSError as error:
                raise LegsError(f"cannot write to {folder}: {error.strerror or error}") from None
        for label in ("loss", "psnr", "gaussians"):
            writers[name].add_scalar(label, getattr(progress, label), progress.iteration)

    try:
        yield log
    finally:
        for writer in writers.values():
            writer.close()
