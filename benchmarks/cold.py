"""Measure what the first call on a machine costs: the seconds that numba compiles, by function, in an empty cache.

Each case runs in a process of its own with one thread. Exit code 1 where the whole process takes more than its budget.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any, Dict, List

CALL = "import torch, legs_loss as l\nx, y = torch.rand(3, 96, 128, requires_grad=True), torch.rand(3, 96, 128)\n"
DRAW = (
    "from legs_loss.lab.embedded import write_embedded_scene\nwrite_embedded_scene(__import__('pathlib').Path('scene'))"
)
TRAIN = "from legs_loss.cli import main\nmain(['train', 'scene', '-m', 'out', '--iterations', '3', '--threads', '1'])"
CASES = {
    "l1_loss": CALL + "l.l1_loss(x, y).backward()",
    "legs_loss": CALL + "l.legs_loss(x, y).backward()",
    "train": TRAIN,
}
BUDGET = {"l1_loss": 8.0, "legs_loss": 12.0, "train": 35.0}  # seconds of the processor, imports included


def child(case: str) -> Dict[str, Any]:
    """Run a case; return the seconds of the process, and those of each function itself."""
    from numba.core import event

    running: List[List[float]] = []
    functions: Dict[str, float] = {}

    class Clock(event.Listener):
        def on_start(self, event: Any) -> None:
            running.append([time.process_time(), 0.0])

        def on_end(self, event: Any) -> None:
            begun, inner = running.pop()
            took = time.process_time() - begun
            if running:
                running[-1][1] += took
            function = event.data["dispatcher"].py_func
            name = f"{function.__module__}.{function.__qualname__}"
            functions[name] = functions.get(name, 0.0) + took - inner

    event.register("numba:compile", Clock())
    exec(CASES[case], {})
    return {"seconds": time.process_time(), "functions": functions}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", help="write the results there")
    parser.add_argument("--case", choices=CASES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.case:
        print(json.dumps(child(args.case)))
        return 0
    results, over = {}, False
    for case, most in BUDGET.items():
        with tempfile.TemporaryDirectory() as folder:
            environment = dict(os.environ, NUMBA_CACHE_DIR=folder, OMP_NUM_THREADS="1")
            if case == "train":
                subprocess.run([sys.executable, "-c", DRAW], cwd=folder, check=True)
            command = [sys.executable, os.path.abspath(__file__), "--case", case]
            done = subprocess.run(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        found = results[case] = json.loads(done.stdout.splitlines()[-1])
        over |= found["seconds"] > most
        print(f"{case}: {found['seconds']:.1f} s, at most {most:g}; compiling {sum(found['functions'].values()):.1f}")
        for name, seconds in sorted(found["functions"].items(), key=lambda item: -item[1])[:15]:
            print(f"  {seconds:6.2f} {name}")
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)
    return int(over)


if __name__ == "__main__":
    sys.exit(main())
