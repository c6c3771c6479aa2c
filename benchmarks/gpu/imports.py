"""Find the packages that a training script imports and this Python lacks, before its modules are built."""

from __future__ import annotations

from pathlib import Path
from typing import Iterable, Sequence

from legs_adapters.shims.packages import missing

from benchmarks.gpu.options import Skipped

__all__ = ["missing", "need"]


def need(scripts: Sequence[Path], built: Iterable[str] = ()) -> None:
    """Check that `legs run` can run a codebase's scripts; arguments as for :func:`missing`.

    Raises:
        Skipped: they cannot; the message names the packages.
    """
    lacking = sorted({name for script in scripts for name in missing(script, built)})
    if lacking:
        raise Skipped(f"{scripts[0].name} needs what is not installed: {', '.join(lacking)}")
