"""The time of Python for a step on a GPU, without one: forward and backward with a driver that launches nothing.

    python -m benchmarks --parts cuda-host

The libcuda of the tests (compiled by g++) takes each call and returns; the images are of the CPU and tiny, so what is
timed is autograd, the packing of arguments and the calls. On a GPU torch's own allocations cost a little more, and the
values of a given map are not checked.

`legs_loss.l1_loss` and `legs_loss.legs_loss` are called as a script does, settings and memo included. One measure is
torch's own |a - b|.mean(). The other is the least that SSIM alone can take in Python: an autograd.Function that
allocates a map and two slopes and launches a kernel, takes the map's mean, and in backward allocates a gradient and
launches another. Exit status 1 where one of ours takes more than its goal, a multiple of a measure.
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

import legs_loss
from legs_loss.kernels.available import BACKENDS, Availability
from legs_loss.kernels.cuda.backend import THREADS, CudaBackend, Task
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.modules import PLAIN, BinaryCache, Modules
from legs_loss.kernels.cuda.nvrtc import Compiler
from legs_loss.runtime import memo, state
from tests.cuda_emulation import COMPILER, TRIED, Runtime, libraries

STEPS = 200
THIN, OWN = "a thin wrapper of SSIM", "torch's own |a - b|.mean()"
GOALS = {"legs_loss": (THIN, 1.0), "l1_loss, the target is remembered": (OWN, 1.1)}


class Thin(torch.autograd.Function):
    """A wrapper that checks nothing and packs nothing anew: one launch each way."""

    @staticmethod
    def forward(ctx: Any, prediction: torch.Tensor, target: torch.Tensor, launch: Callable[[], None]) -> torch.Tensor:
        similarity, first, second = (torch.empty_like(prediction) for _ in range(3))
        launch()
        ctx.save_for_backward(prediction, target, first, second)
        ctx.launch = launch
        return similarity

    @staticmethod
    def backward(ctx: Any, *arrived: torch.Tensor) -> Any:
        prediction = ctx.saved_tensors[0]
        gradient = torch.empty_like(prediction)
        ctx.launch()
        return gradient, None, None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", help="write everything to this file")
    args = parser.parse_args()
    if COMPILER is None:
        print("needs g++", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    driver = CudaDriver(torch.device("cpu"), libraries().cuda, Runtime())  # as on a GPU, where no test looks on
    modules = Modules(driver, Compiler(libraries().nvrtc), BinaryCache(libraries().cache))
    backend, device = CudaBackend(lambda device: modules), torch.device("cpu")
    BACKENDS.known = {"cpu": ("cuda", "as on a GPU")}
    BACKENDS.found = {device: Availability(backend, "", TRIED)}
    # As on a GPU, a target is known by its memory, not by its values.
    memo._key = memo._identity_key
    state.current_run().computes = False
    target = torch.rand(3, 8, 8)
    prediction = (0.9 * target).requires_grad_()
    stored = torch.rand(1, 8, 8)
    task, kernel = Task(), (modules.function("legs_finish", PLAIN), 1, THREADS)
    steps: Dict[str, Callable[[], Any]] = {
        "legs_loss": lambda: legs_loss.legs_loss(prediction, target),
        "legs_loss, a map is given": lambda: legs_loss.legs_loss(prediction, target, weight=stored),
        "l1_loss, the target is remembered": lambda: legs_loss.l1_loss(prediction, target),
        "ssim": lambda: legs_loss.ssim(prediction, target),
        THIN: lambda: Thin.apply(prediction, target, lambda: driver.launch(task, kernel)).mean(),
        OWN: lambda: (prediction - target).abs().mean(),
    }
    result = torch.empty(())
    task.result = result.data_ptr()
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
        print(f"{name:<42} {statistics.median(values):6.0f} us  ({min(values):.0f} to {max(values):.0f})")
    if args.json:
        Path(args.json).write_text(json.dumps({"us": found}) + "\n", encoding="utf-8")
    above = []
    for name, (measure, goal) in GOALS.items():
        ratios = [one / other for one, other in zip(found[name], found[measure])]
        ratio = statistics.median(ratios)
        print(f"{name}: {ratio:.2f} ({min(ratios):.2f} to {max(ratios):.2f}) of {measure}; the goal is {goal}")
        above += [name] if ratio > goal else []
    return 1 if above else 0


def microseconds(step: Callable[[], Any], prediction: torch.Tensor) -> float:
    """Return the processor's time of a step, forward and backward."""
    before = time.process_time()
    for _ in range(STEPS):
        prediction.grad = None
        step().backward()
    return 1e6 * (time.process_time() - before) / STEPS


if __name__ == "__main__":
    sys.exit(main())
