"""The time of Python for a step on a GPU, without one: forward and backward with a driver that launches nothing.

    python -m benchmarks --parts cuda-host

The libcuda of the tests (compiled by g++) takes each call and returns; the images are of the CPU and tiny, so what is
timed is autograd, the packing of arguments and the calls. On a GPU torch's own allocations cost a little more.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any, Callable, Dict

import torch

from legs_loss.kernels.contract import Weights
from legs_loss.spec import PRESETS
from tests.cuda_emulation import COMPILER, emulated, libraries

STEPS = 200
GOAL = 60.0  # microseconds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", help="write everything to this file")
    args = parser.parse_args()
    if COMPILER is None:
        print("needs g++", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    backend, spec = emulated(), PRESETS["legs"]
    target = torch.rand(1, 3, 8, 8)
    prediction = (0.9 * target).requires_grad_()
    kept, stored = backend.response_range(target, spec), torch.rand(1, 1, 8, 8)
    steps: Dict[str, Callable[[], Any]] = {
        "the whole loss, weights from the target": lambda: backend.loss(prediction, target, Weights(spec), 0.2),
        "the whole loss, stored map": lambda: backend.loss(prediction, target, Weights(map=stored), 0.2),
        "L1, remembered range": lambda: backend.weighted_l1(prediction, target, Weights(spec, kept)),
        "SSIM": lambda: backend.ssim(prediction, target),
        "torch's own |a - b|.mean()": lambda: (prediction - target).abs().mean(),
    }
    for step in steps.values():
        step().backward()
    library, context = libraries().cuda, ctypes.c_void_p()
    library.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0)
    library.cuCtxSetCurrent(context)  # as torch leaves it in the threads that it uses
    library.test_dry(1)
    found: Dict[str, Any] = {name: [] for name in steps}
    for _ in range(args.rounds):
        for name, step in steps.items():
            found[name].append(microseconds(step, prediction))
    for name, values in found.items():
        print(
            f"{name:<42} {statistics.median(values):6.0f} us  ({min(values):.0f} to {max(values):.0f}; goal {GOAL:.0f})"
        )
    if args.json:
        Path(args.json).write_text(json.dumps({"us": found}) + "\n", encoding="utf-8")
    return 0


def microseconds(step: Callable[[], Any], prediction: torch.Tensor) -> float:
    """Return the processor's time of a step, forward and backward."""
    before = time.process_time()
    for _ in range(STEPS):
        prediction.grad = None
        step().backward()
    return 1e6 * (time.process_time() - before) / STEPS


if __name__ == "__main__":
    sys.exit(main())
