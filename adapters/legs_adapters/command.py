"""Run a training script with the LEGS loss, without changing its files; with --cpu on a machine without a GPU.

Runs like `python SCRIPT ARGUMENTS`, with the photometric L1 term of its training step weighted: the edits of legs-patch
are made in memory. Settings come from legs.toml and LEGS_* variables, as for a patched script. With --cpu, CUDA calls
run on the CPU and a shim replaces the rasterizer: slow, but it trains.
"""

from __future__ import annotations

import argparse
import os

from legs_adapters.cli import check_parser
from legs_loss.errors import require

HELP = "run a training script with the LEGS loss, without changing its files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--cpu", action="store_true", help="run without a GPU, with shims for CUDA modules")
    parser.add_argument("--ssim", action="store_true", help="also compute the SSIM of the loss by legs_loss.ssim")
    parser.add_argument("--masks", action="store_true", help="also hide masked pixels from the other terms of the loss")
    parser.add_argument("script", metavar="SCRIPT", help="the training script")
    parser.add_argument("arguments", metavar="...", nargs=argparse.REMAINDER, help="its own arguments")


def run(args: argparse.Namespace) -> int:
    """Run the script and return its exit code."""
    check_parser()
    if args.cpu:
        require("legs run --cpu", "cpu", "numba", "scipy")
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # or torch's idle threads spin on the cores that ours need
    from legs_adapters.runner import run_script

    return run_script(args.script, args.arguments, args.cpu, args.ssim, args.masks)
