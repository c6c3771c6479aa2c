"""Run a training script as `legs run` does, and time its steps.

    python -m benchmarks.gpu.measured REPORT [--emulate] [--cpu] SCRIPT ...

A step is the time from one call of `Tensor.backward` to the next. The report is that of
`legs_loss.experiments.upstream.launch`, with the number of steps, their times, and the peak of the memory.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path
from typing import Any, Dict, List

import torch

from benchmarks.gpu.options import emulate
from legs_loss.experiments.upstream import launch

FIRST = 0.1  # the share of the steps that is not timed: loading, compiling, first touches of memory


def main(report: str, *words: str) -> int:
    """Run the script; write the report, whatever happens."""
    if words[0] == "--emulate":
        emulate()
        words = words[1:]
    stamps: List[float] = []
    backward = torch.Tensor.backward

    def stamped(self: torch.Tensor, *args: Any, **settings: Any) -> Any:
        stamps.append(time.perf_counter())
        return backward(self, *args, **settings)

    torch.Tensor.backward = stamped  # type: ignore[method-assign,assignment]
    path = Path(report)
    try:
        return launch.main(report, "0", *words)
    finally:
        found = {**json.loads(path.read_text(encoding="utf-8")), **steps(stamps), **memory("--cpu" in words)}
        path.write_text(json.dumps(found), encoding="utf-8")


def steps(stamps: List[float]) -> Dict[str, Any]:
    """Return the number of steps, and the mean and median milliseconds of all but the first.

    >>> steps([0.0, 5.0, 5.25, 5.5, 5.75, 6.0, 6.25, 6.5, 6.75, 7.0, 7.25, 8.0])
    {'steps': 12, 'ms a step': 300.0, 'median ms a step': 250.0}
    """
    timed = stamps[max(1, int(FIRST * len(stamps))) :]
    if len(timed) < 2:
        return {"steps": len(stamps)}
    apart = [1e3 * (after - before) for before, after in zip(timed, timed[1:])]
    return {"steps": len(stamps), "ms a step": statistics.mean(apart), "median ms a step": statistics.median(apart)}


def memory(cpu: bool) -> Dict[str, Any]:
    """Return the peak of what torch allocated on the GPU, or of the process's memory."""
    if not cpu:
        return {"peak MB": torch.cuda.max_memory_allocated() / 1e6}
    import resource

    return {"peak MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
