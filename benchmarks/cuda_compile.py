"""Compile every variant of the CUDA kernels for real GPUs, without one: registers, spills, shared memory. Writes JSON.

    pip install nvidia-cuda-nvrtc-cu12 nvidia-cuda-nvrtc     # the compilers of CUDA 12 and 13
    python -m benchmarks --parts cuda-compile

With nvdisasm beside it (`pip install nvidia-cuda-nvdisasm`) the instructions that a warp executes for 32 values are
counted (cuda_instructions.py), for NVRTC 12 and sm_89 and sm_90, against the budget there.

Each NVRTC that lies in a package named nvidia is used, for the GPUs that it knows. A stack is counted too: an array
that is indexed at run time lies in memory though nothing is spilled. Exit status 1 where a kernel has a spill, a stack
or more than 48 kB of shared memory, which not every GPU has, or is above its budget of instructions; 2 where there is
no compiler.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import statistics
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Sequence, Tuple

from benchmarks import cuda_instructions
from legs_loss.kernels.codes import NORMS, STENCILS
from legs_loss.kernels.cuda.backend import VALUES
from legs_loss.kernels.cuda.modules import Variant, options, source
from legs_loss.kernels.cuda.nvrtc import Compiler, NotFound, find_compiler

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)
MAJORS = ("11", "12", "13")
MOST_SHARED = 48 * 1024


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--architectures", nargs="+", type=int, default=ARCHITECTURES)
    parser.add_argument("--only", nargs="+", help="only these variants, as 0,1,2 for value, stencil, norm")
    parser.add_argument("--json", help="write everything to this file")
    args = parser.parse_args()
    compilers = found_compilers()
    if not compilers:
        print("there is no NVRTC here: pip install nvidia-cuda-nvrtc-cu12 nvidia-cuda-nvrtc", file=sys.stderr)
        return 2
    chosen = [Variant(*map(int, name.split(","))) for name in args.only] if args.only else variants()
    rows: List[Dict[str, Any]] = []
    for compiler in compilers:
        for architecture in args.architectures:
            if compiler.target(architecture) != f"sm_{architecture}":
                print(f"NVRTC {compiler.version} does not know sm_{architecture}", flush=True)
                continue
            rows += measured(compiler, architecture, chosen)
    bad = [row for row in rows if row["spills"] or row["stack"] or row["shared"] > MOST_SHARED]
    for row in bad:
        print(f"BAD {row}")
    counts, above = instructions(compilers, args.architectures)
    for name in above:
        print(f"ABOVE ITS BUDGET {name}")
    print(f"{len(rows)} kernels of {len(chosen)} variants, {len(bad)} with a spill, a stack or over 48 kB")
    if args.json:
        Path(args.json).write_text(json.dumps({"kernels": rows, "instructions": counts}) + "\n", encoding="utf-8")
    return 1 if bad or above else 0


def instructions(compilers: List[Compiler], architectures: Sequence[int]) -> Tuple[Dict[str, Any], List[str]]:
    """Count the instructions of the GPUs that :mod:`cuda_instructions` knows; return the counts, and what is above."""
    nvdisasm = cuda_instructions.disassembler()
    if nvdisasm is None:
        print("there is no nvdisasm here: pip install nvidia-cuda-nvdisasm")
        return {}, []
    counts, above = {}, []
    for compiler in (each for each in compilers if each.version.startswith("12.")):
        for architecture in sorted({89, 90} & set(architectures)):
            counts[f"sm_{architecture}"], over = cuda_instructions.report(compiler, architecture, nvdisasm)
            above += over
    return counts, above


def found_compilers() -> List[Compiler]:
    compilers = []
    for major in MAJORS:
        try:
            compilers.append(find_compiler(version=major))
        except NotFound:
            continue
    return compilers


def variants() -> List[Variant]:
    """Return every variant that a loss can ask for."""
    stencils = sorted({kind for kind, _, _ in STENCILS.values()})
    weighted = itertools.product(VALUES.values(), stencils, NORMS.values())
    return [*(Variant(value) for value in VALUES.values()), *(Variant(*each) for each in weighted)]


def measured(compiler: Compiler, architecture: int, chosen: List[Variant]) -> List[Dict[str, Any]]:
    """Compile the variants for a GPU; print what its kernels need at most, and return it all."""
    rows, seconds = [], []
    for variant in chosen:
        given = [*options(variant), "--ptxas-options=-v"]
        before = time.perf_counter()
        _, log = compiler.compile(source(), given, f"sm_{architecture}")
        seconds.append(time.perf_counter() - before)
        kernels = resources(log)
        if not kernels:
            raise SystemExit(f"NVRTC {compiler.version} did not say what its kernels need: {log[:200]!r}")
        rows += [row(compiler, architecture, variant, kernel) for kernel in kernels]
    print(
        f"NVRTC {compiler.version}  sm_{architecture:<4} {len(chosen)} variants  "
        + "  ".join(f"{name} {max(each[name] for each in rows)}" for name in ("registers", "stack", "spills", "shared"))
        + f"  compiled in {statistics.median(seconds):.2f} s (median), {max(seconds):.2f} s (longest)",
        flush=True,
    )
    return rows


def row(
    compiler: Compiler, architecture: int, variant: Variant, kernel: Tuple[str, int, int, int, int]
) -> Dict[str, Any]:
    name, registers, stack, spills, shared = kernel
    return {
        "nvrtc": compiler.version,
        "gpu": f"sm_{architecture}",
        "variant": list(variant),
        "kernel": name,
        "registers": registers,
        "stack": stack,
        "spills": spills,
        "shared": shared,
    }


def resources(log: str) -> List[Tuple[str, int, int, int, int]]:
    """Return of each kernel in the log of ``--ptxas-options=-v``: name, registers, stack, spills, shared bytes."""
    found = []
    for part in re.split(r"Compiling entry function '", log)[1:]:
        numbers = [
            sum(map(int, re.findall(pattern, part)))
            for pattern in (
                r"Used (\d+) registers",
                r"(\d+) bytes stack frame",
                r"(\d+) bytes spill (?:stores|loads)",
                r"(\d+) bytes smem",
            )
        ]
        found.append((part.split("'")[0], numbers[0], numbers[1], numbers[2], numbers[3]))
    return found


if __name__ == "__main__":
    sys.exit(main())
