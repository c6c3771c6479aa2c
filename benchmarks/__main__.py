"""Every benchmark of the project, one after the other; all results in one JSON file.

    python -m benchmarks                                      # all of them: an hour on a slow machine
    python -m benchmarks --parts loss-1 memory --json all.json
    python -m benchmarks --parts cuda-compile                 # the CUDA kernels for seven GPUs, without one
    python -m benchmarks --parts gpu-800x533 gpu-1297x840     # on a machine with a GPU, where they are among all

What is measured again replaces what the file has of it; the rest stays, so a long measurement may be divided, by parts
or, with --only CONTENDER ..., by contenders: a row's ratio is always to ours of the same run.
What each part measures and how is said by its script, `python benchmarks/NAME.py --help`.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, List

import torch

HERE = Path(__file__).resolve().parent

# A part: its script, and what it is called with.
PARTS: Dict[str, List[str]] = {
    "loss-1": ["loss.py", "--parts", "loss", "--threads", "1"],
    "loss-2": ["loss.py", "--parts", "loss", "--threads", "2"],
    "weights-1": ["loss.py", "--parts", "weights", "--threads", "1"],
    "weights-2": ["loss.py", "--parts", "weights", "--threads", "2"],
    "drop-in-1": ["drop_in.py", "--threads", "1"],
    "drop-in-2": ["drop_in.py", "--threads", "2"],
    "memory": ["loss.py", "--parts", "memory"],
    "threads-2": ["loss.py", "--parts", "threads", "--threads", "2", "--rounds", "25"],
    "growth": ["loss.py", "--parts", "growth", "--rounds", "3"],
    "precompute": ["precompute.py"],
    "precompute-r1": ["precompute.py", "--resolution", "1"],
    "precompute-r8": ["precompute.py", "--resolution", "8"],
    "rasterizer-1": ["rasterizer.py", "--threads", "1"],
    "rasterizer-2": ["rasterizer.py", "--threads", "2"],
    "cpu-1": ["cpu.py", "--threads", "1"],
    "cold": ["cold.py"],
}
# Of CUDA, without a GPU: the first needs its compilers, the second g++.
COMPILE = {"cuda-compile": ["cuda_compile.py"], "cuda-host": ["cuda_host.py"]}
GPU = {
    f"gpu-{size}": ["loss.py", "--device", "cuda", "--parts", "loss", "memory", "--size", size]
    for size in ("800x533", "1297x840", "1600x1066", "3840x2160")
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = {**PARTS, **COMPILE, **GPU}
    default = list({**PARTS, **GPU} if torch.cuda.is_available() else PARTS)
    parser.add_argument("--parts", nargs="+", choices=parts, default=default, metavar="PART", help=", ".join(parts))
    parser.add_argument("--json", default="benchmarks.json", help="the file of results (default: %(default)s)")
    args, extra = parser.parse_known_args()  # what is left is for the scripts: --rounds 3
    path = Path(args.json)
    results = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    failed = []
    for part in args.parts:
        command = [*parts[part], *extra]
        print(f"\n== {part}: python benchmarks/{shlex.join(command)}", flush=True)
        found = measure(command)
        if found is None:
            failed.append(part)
            continue
        merge(results.setdefault(part, {}), {"command": f"python benchmarks/{shlex.join(command)}", **found})
        path.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def merge(old: Dict[str, Any], new: Dict[str, Any]) -> None:
    """Put new results into old ones, table by table and row by row."""
    for name, value in new.items():
        if isinstance(value, dict) and isinstance(old.get(name), dict):
            old[name].update(value)
        else:
            old[name] = value


def measure(command: List[str]) -> Any:
    """Run a script; return its JSON, its output where it writes none, or None if it fails."""
    search = os.pathsep.join([str(HERE.parent), str(HERE.parent / "adapters"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": search}
    if "--threads" in command:
        environment["OMP_NUM_THREADS"] = command[command.index("--threads") + 1]
    writes = "--json" in (HERE / command[0]).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "result.json"
        arguments = [sys.executable, str(HERE / command[0]), *command[1:], *(["--json", str(file)] if writes else [])]
        with subprocess.Popen(arguments, env=environment, stdout=subprocess.PIPE, text=True) as running:
            lines = []
            assert running.stdout is not None
            for line in running.stdout:
                print(line, end="", flush=True)
                lines.append(line.rstrip("\n"))
        if running.returncode != 0:
            return None
        return json.loads(file.read_text(encoding="utf-8")) if writes else {"printed": lines}


if __name__ == "__main__":
    sys.exit(main())
