"""Running an upstream training script without a GPU: devices redirected, CUDA modules replaced by stand-ins."""

from __future__ import annotations

from pathlib import Path

from legs_adapters.cpu.missing import MissingStandIn

__all__ = ["MissingStandIn", "start"]


def start(root: Path) -> None:
    """Answer for CUDA in this process, for the codebase in ``root``, until it ends."""
    from legs_adapters.cpu import nvidia_smi, redirect, standins
    from legs_adapters.cpu.survey import survey

    redirect.redirect()
    nvidia_smi.offer()
    standins.install(standins.table_for(survey(root)))
