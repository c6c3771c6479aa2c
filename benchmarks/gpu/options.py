"""The options of a run, as every stage gets them, and the types of its results."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Callable, Optional, Tuple

import torch

__all__ = ["ROOT", "Options", "Record", "Skipped", "emulate", "first_line"]

ROOT = Path(__file__).resolve().parents[2]
Record = Callable[..., None]  # keeps results by name, at once


class Skipped(Exception):
    """A stage cannot be done here; the message says why."""


@dataclass(frozen=True)
class Options:
    """The options of a run; paths are absolute strings, so that it can be written as JSON.

    Attributes:
        emulate: run on the CPU, the kernels compiled with g++.
        sizes: of the timed images, as "1297x840".
        rounds: how often the contenders take turns.
        work: a folder for copies, modules and trainings.
        fastgs, gsplat, fused_ssim: checkouts; fused_ssim's is FastGS's submodule if it is not given.
        scene: what is trained on.
        iterations, resolution: of a training; resolution is 3DGS's -r.
    """

    emulate: bool
    sizes: Tuple[str, ...]
    rounds: int
    work: str
    fastgs: Optional[str]
    gsplat: Optional[str]
    fused_ssim: Optional[str]
    scene: Optional[str]
    iterations: int
    resolution: Optional[int]

    @property
    def site(self) -> Path:
        """The folder that built modules are installed in."""
        return Path(self.work) / "site"

    def device(self) -> torch.device:
        """Return the device that is measured; with ``emulate`` the kernels on the CPU are made ready first."""
        if self.emulate:
            emulate()
        return torch.device("cpu" if self.emulate else "cuda")


def emulate() -> None:
    """Put the CUDA kernels, compiled with g++, in the place of the CPU's backend in this process."""
    from legs_loss.kernels.available import BACKENDS, Availability

    sys.path.insert(0, str(ROOT))
    from tests.cuda_emulation import TRIED, emulated

    BACKENDS.known = {"cpu": ("cuda", "tests.cuda_emulation")}
    backend = emulated()
    known = Availability(backend, "emulated on the CPU", TRIED)
    BACKENDS.found = {torch.device("cpu"): known}


def first_line(error: Any) -> str:
    """Return an error's type and the first line of its message."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else 'no message'}"
