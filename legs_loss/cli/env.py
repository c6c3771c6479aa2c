"""Print versions, devices and the backend that computes the loss, for a bug report."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
from typing import Iterator, Tuple

from legs_loss._version import __version__
from legs_loss.system.terminal import say

HELP = "print versions, devices and the backend of the loss, for a bug report"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add this command's arguments to its parser: it has none."""


def run(args: argparse.Namespace) -> int:
    """Print the findings, a line each, and return the exit code."""
    for name, value in _lines():
        say(f"{name:<16} {value}")
    return 0


def _lines() -> Iterator[Tuple[str, str]]:
    import torch

    from legs_loss.kernels.available import BACKENDS

    yield "legs-loss", __version__
    yield "python", f"{platform.python_version()}, {platform.platform()}"
    yield "torch", f"{torch.__version__}, {torch.get_num_threads()} threads"
    yield "CUDA", _cuda()
    for name, package in (("numba", "numba"), ("fused-ssim", "fused_ssim")):
        yield name, _version(package)
    yield "LEGS_BACKEND", os.environ.get("LEGS_BACKEND") or "not set"
    for kind in ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",):
        device = torch.device(kind)
        trial = f"{BACKENDS.known[kind][0]}: {BACKENDS.availability(device).reason}"
        yield f"loss on {kind}", f"{BACKENDS.chosen(device)}; {trial}"


def _cuda() -> str:
    import torch

    if torch.version.cuda is None:
        return "this torch is built without it"
    if not torch.cuda.is_available():
        return f"{torch.version.cuda}, no device"
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return f"{torch.version.cuda}, {', '.join(names)}"


def _version(package: str) -> str:
    try:
        module = importlib.import_module(package)
    except ImportError as error:
        return "not installed" if getattr(error, "name", None) == package else f"broken: {error}"
    except Exception as error:  # whatever a broken install raises
        return f"broken: {type(error).__name__}: {error}"
    return str(getattr(module, "__version__", "installed"))
