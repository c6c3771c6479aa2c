"""Find the rank of this process, so that messages about the whole run are printed once."""

from __future__ import annotations

import os
import sys

__all__ = ["is_first_process"]


def is_first_process() -> bool:
    """Return whether this process is rank 0 of its run, or the run's only one.

    The process group says so once it is initialised; before that, RANK as torchrun and Slurm's wrappers set it. torch
    is not imported for it.

    >>> is_first_process()
    True
    """
    distributed = sys.modules.get("torch.distributed")
    if distributed is not None and distributed.is_available() and distributed.is_initialized():
        return bool(distributed.get_rank() == 0)
    return os.environ.get("RANK", "0") in ("", "0")
