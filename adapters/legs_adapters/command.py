"""Run a training script with the LEGS loss, without changing its files; with --cpu on a machine without a GPU.

Runs like `python SCRIPT ARGUMENTS`, with the photometric L1 term of its training step weighted: the edits of legs-patch
are made in memory. Settings come from legs.toml and LEGS_* variables, as for a patched script. With --cpu, CUDA calls
run on the CPU and a shim replaces the rasterizer: slow, but it trains.
"""

from __future__ import annotations

import argparse
import os
from typing import Sequence

from legs_loss import LegsError

HELP = "run a training script with the LEGS loss, without changing its files"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--cpu", action="store_true", help="run without a GPU, with shims for CUDA modules")
    parser.add_argument("--ssim", action="store_true", help="also compute the SSIM of the loss by legs_loss.ssim")
    parser.add_argument("--masks", action="store_true", help="also hide masked pixels from the other terms of the loss")
    parser.add_argument("script", metavar="SCRIPT", help="the training script")
    parser.add_argument("arguments", metavar="...", nargs=argparse.REMAINDER, help="its own arguments")


def run(args: argparse.Namespace) -> int:
    """Run the script and return its exit code.

    Raises:
        LegsError: an option of ours stands behind the script, which does not know it.
    """
    _refuse_ours(args.script, args.arguments)
    try:
        from legs_adapters.runner import run_script
    except ModuleNotFoundError as error:
        if error.name != "libcst":
            raise
        raise LegsError("legs run needs LibCST: pip install 'legs-loss[patch]'") from None
    return run_script(args.script, args.arguments, args.cpu, args.ssim, args.masks)


def _refuse_ours(script: str, arguments: Sequence[str]) -> None:
    """Raise for `legs run train.py --cpu`: what stands behind the script is the script's own."""
    ours = [word for word in arguments if word in ("--cpu", "--ssim", "--masks")]
    if ours and os.path.isfile(script):
        with open(script, encoding="utf-8", errors="replace") as file:
            text = file.read()
        for option in ours:
            if option[2:] not in text:
                raise LegsError(
                    f"{option} stands behind {script}, which does not know it: legs run {option} {script} ..."
                )
