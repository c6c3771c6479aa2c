"""Run a training script as `legs run` does, and time its steps.

    python -m benchmarks.gpu.measured REPORT EQUAL [--emulate] [--cpu] SCRIPT ...

A step is the time from one call of `Tensor.backward` to the next. The report is that of
`examples/reproduce_paper/launch.py`, with the number of steps, their times, and the peak of the memory. The times
are told twice: of the first EQUAL steps, in which no Gaussian is added yet, so that two losses have as many to draw;
and of all steps, in which a loss that adds more of them takes longer for that.
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
from examples.reproduce_paper import launch

EQUAL = "ms a step before Gaussians are added"
FIRST = 0.03  # the share of the steps that is not timed: loading, compiling, first touches of memory


def main(report: str, equal: str, *words: str) -> int:
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
        found = {
            **json.loads(path.read_text(encoding="utf-8")),
            **steps(stamps, int(equal)),
            **memory("--cpu" in words),
        }
        path.write_text(json.dumps(found), encoding="utf-8")


def steps(stamps: List[float], equal: int) -> Dict[str, Any]:
    """Return the number of steps, and the milliseconds of one: of all but the first, and of those before ``equal``.

    >>> found = steps([0.0, 5.0, 5.25, 5.5, 5.75, 6.0, 6.5, 7.0, 7.5, 8.0, 8.5, 9.5], equal=6)
    >>> found["steps"], found["ms a step"], found["median ms a step"], found["ms a step before Gaussians are added"]
    (12, 450.0, 500.0, 250.0)
    """
    first = max(1, int(FIRST * len(stamps)))
    apart = [1e3 * (after - before) for before, after in zip(stamps, stamps[1:])][first:]
    if not apart:
        return {"steps": len(stamps)}
    found = {"steps": len(stamps), "ms a step": statistics.mean(apart), "median ms a step": statistics.median(apart)}
    if equal - 1 > first:
        found[EQUAL] = statistics.mean(apart[: equal - 1 - first])
    return found


def memory(cpu: bool) -> Dict[str, Any]:
    """Return the peak of torch's memory on the GPU, or of the process's memory."""
    if not cpu:
        return {"peak MB": torch.cuda.max_memory_allocated() / 1e6}
    import resource

    return {"peak MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3}


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
