"""Everything that needs a GPU, in one command of at most 25 minutes; its results are kept when it is interrupted.

    python -m benchmarks.gpu --fastgs FastGS/ --scene fox/             # all of it, on a GPU
    python -m benchmarks.gpu --stages machine tests                    # some of it; the file keeps the rest
    python -m benchmarks.gpu --emulate --fastgs FastGS/ --scene fox/   # its rehearsal on a CPU, with g++

The stages, in this order: versions and the bandwidth of a copy; the tests of the kernels on the device, then some of
them under compute-sanitizer's racecheck and memcheck; fused-ssim built from source; times of the losses for each size;
FastGS's modules built from source in a copy; FastGS trained on the scene, plain and with LEGS: these fit into the time
together. Then, as far as it goes: waits for the device; CUDA graphs; a second stream; torch.compile; gsplat's
simple_trainer.py trained likewise. Each runs in a process of its own, with a time limit, and writes what it finds to
the file at once. A stage that fails or cannot be done here is named with the reason, and the next one begins.

The package must be installed (`pip install -e .`) and the checkouts be fetched with their submodules; nothing
is written into them, and nothing is downloaded. With --emulate the kernels' source is compiled with g++ and runs on
the CPU: it tries this script, its times mean nothing, and what only a GPU has is said to need CUDA.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Dict, Tuple

import torch

from benchmarks.gpu.aims import judged
from benchmarks.gpu.options import Options
from benchmarks.gpu.running import run_stage
from benchmarks.gpu.stages import STAGES

SIZES = ("800x533", "1297x840", "1920x1080", "3840x2160")
MINUTES = 25.0  # for which the limits of the stages are made; with more time they grow in proportion


def main() -> int:
    args, options = parse()
    signal.signal(signal.SIGTERM, _interrupt)
    file, deadline = Path(args.json), time.monotonic() + 60 * args.minutes
    results: Dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        options = Options(**{**vars(options), "work": options.work or folder})
        Path(options.work).mkdir(parents=True, exist_ok=True)
        for name in args.stages:
            left = deadline - time.monotonic()
            print(f"\n== {name}", flush=True)
            if left <= 0:
                _keep(file, results, name, {"status": "skipped", "reason": "no time was left"})
            else:
                seconds = min(left, 60 * STAGES[name].minutes * max(1.0, args.minutes / MINUTES))
                try:
                    run_stage(name, options, seconds, lambda found, name=name: _keep(file, results, name, found))
                except KeyboardInterrupt:
                    print(f"interrupted; {file} has what was found", file=sys.stderr)
                    return 130
            print(
                "  ".join(str(results[name][key]) for key in ("status", "reason") if key in results[name]), flush=True
            )
    _keep(file, results, "aims", judged(results))
    print("\n" + "\n".join(f"{aim}: {verdict}" for aim, verdict in results["aims"].items()))
    bad = [name for name in args.stages if results[name]["status"] in ("failed", "timed out")]
    print(f"written to {file}" + (f"; not well: {', '.join(bad)}" if bad else ""))
    return 1 if bad else 0


def _keep(file: Path, results: Dict[str, Any], name: str, found: Dict[str, Any]) -> None:
    """Put a stage's results into the file, in one step."""
    results[name] = found
    part = file.with_name(file.name + ".part")
    part.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    part.replace(file)


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def parse() -> Tuple[argparse.Namespace, Options]:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", default="gpu.json", help="the file of results (default: %(default)s)")
    parser.add_argument(
        "--minutes", type=float, default=MINUTES, help="for everything; then it ends (default: %(default)s)"
    )
    parser.add_argument(
        "--stages", nargs="+", choices=STAGES, default=list(STAGES), metavar="STAGE", help="of: %(choices)s"
    )
    parser.add_argument("--emulate", action="store_true", help="on the CPU, with g++")
    parser.add_argument("--sizes", nargs="+", help=f"of the timed images (default: {' '.join(SIZES)}; emulated: 40x30)")
    parser.add_argument("--rounds", type=int, help="of the timed contenders (default: 9; emulated: 1)")
    parser.add_argument("--fastgs", metavar="CHECKOUT", help="FastGS, with its submodules")
    parser.add_argument("--gsplat", metavar="CHECKOUT", help="gsplat, whose package is installed")
    parser.add_argument("--fused-ssim", metavar="CHECKOUT", help="default: the submodule of FastGS")
    parser.add_argument("--scene", metavar="FOLDER", help="a COLMAP scene to train on")
    parser.add_argument("--iterations", type=int, help="of a training (default: 3000; emulated: 12)")
    parser.add_argument("-r", "--resolution", type=int, help="3DGS's -r (default: the codebase's; emulated: 48 wide)")
    parser.add_argument("--work", metavar="FOLDER", help="keep copies, built modules and trainings here")
    args = parser.parse_args()
    if args.emulate:
        from tests.cuda_emulation import COMPILER

        if COMPILER is None:
            parser.error("--emulate needs g++")
    elif not torch.cuda.is_available():
        parser.error("torch finds no CUDA GPU here (--emulate tries this script on the CPU)")
    usual: Dict[str, Any] = {"sizes": SIZES, "rounds": 9, "iterations": 3000, "resolution": None}
    if args.emulate:
        usual = {"sizes": ("40x30",), "rounds": 1, "iterations": 12, "resolution": 48}
    chosen = {name: value if getattr(args, name) is None else getattr(args, name) for name, value in usual.items()}
    paths = {
        name: getattr(args, name) and str(Path(getattr(args, name)).resolve())
        for name in ("work", "fastgs", "gsplat", "fused_ssim", "scene")
    }
    for name in ("fastgs", "gsplat", "fused_ssim", "scene"):
        if paths[name] and not Path(paths[name]).is_dir():
            parser.error(f"there is no folder {paths[name]}")
    return args, Options(emulate=args.emulate, **chosen, **paths)


if __name__ == "__main__":
    sys.exit(main())
