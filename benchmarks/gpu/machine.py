"""Versions, and the bandwidth of a copy."""

from __future__ import annotations

import subprocess

from benchmarks.gpu.options import Options, Record
from benchmarks.losses import machine as machines
from benchmarks.losses.timing import copy_bandwidth
from legs_loss.kernels.available import BACKENDS

__all__ = ["machine"]


def machine(options: Options, record: Record) -> None:
    """Record the machine and its versions, whether the kernels are used, and how fast a copy is."""
    device = options.device()
    record(**machines.machine(device), emulated=options.emulate)
    for name, command in (
        ("driver", ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]),
        ("nvcc", ["nvcc", "--version"]),
    ):
        record(**{name: _said_by(command)})
    backend = BACKENDS.chosen(device)
    reason = BACKENDS.availability(device).reason
    record(**{"backend": f"{backend}: {reason}", "GB/s of a copy": copy_bandwidth(device) / 1e9})
    if backend != "cuda":
        raise RuntimeError(f"the kernels are not used: {reason}")


def _said_by(command: list[str]) -> str:
    """Return the last line that a command prints, or that there is no such command."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    except OSError:
        return "not installed"
    return (done.stdout.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
