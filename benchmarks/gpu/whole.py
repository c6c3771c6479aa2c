"""Train FastGS whole three times, unpatched, patched, and patched with LEGS's SSIM, their steps in turns on one GPU.

    python -m benchmarks.gpu.whole FASTGS SCENE OUT --iterations 30000 --more="--densification_interval 500"

Each arm is a copy of the checkout, trained by its own train.py as it stands. All three are loaded first; then one
trains for TURN steps while the others wait, so that a machine that changes its pace changes it for all. At the end the
views are drawn by the codebase's own renderer and scored with the package's metrics. OUT/rows.json has a row an arm:
the seconds of its own turns, the milliseconds of a step by turn, scores, Gaussians. --cpu rehearses it with the shims.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, List

from benchmarks.gpu.options import ROOT
from benchmarks.gpu.turns import Gate
from examples.reproduce_paper.codebases.training import copy_checkout

ARMS = ("unpatched", "patched", "patched-ssim")
# What legs-patch --ssim leaves to the user: the call of a library.
SSIM = ("ssim_value = fast_ssim(image", "ssim_value = legs_loss.ssim(image")


def main() -> int:
    """Train, score and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("fastgs", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--iterations", type=int, default=30000)
    parser.add_argument("--turn", type=int, default=250)
    parser.add_argument("--more", type=shlex.split, default=[], help="words for every training")
    parser.add_argument("--lpips", default="", metavar="WEIGHTS")
    parser.add_argument("--hold", type=Path, help="load everything, and begin when this file is there")
    parser.add_argument("--cpu", action="store_true")
    args = parser.parse_args()
    out = args.out.resolve()
    gate = Gate(out / "gate", ARMS)
    gate.folder.mkdir(parents=True)
    for arm in ARMS:
        copy_checkout(args.fastgs, out / arm)
        if arm != "unpatched":
            subprocess.run([sys.executable, "-m", "legs_adapters.cli", str(out / arm)], check=True)
    script = out / "patched-ssim" / "train.py"
    text = script.read_text(encoding="utf-8")
    if text.count(SSIM[0]) != 1:
        parser.error(f"{args.fastgs}/train.py has not one line with {SSIM[0]!r}")
    script.write_text(text.replace(*SSIM), encoding="utf-8")
    cpu = ["--cpu"] if args.cpu else []
    command = [*cpu, "train.py", "-s", str(args.scene.resolve()), "-m", "MODEL", "--eval", "--quiet"]
    command += ["--iterations", str(args.iterations), "--save_iterations", str(args.iterations), *args.more]
    running = {
        arm: _start("turns", out, arm, [str(gate.folder), ",".join(ARMS), arm, str(args.turn), *command])
        for arm in ARMS
    }
    codes: Dict[str, int] = {}
    began = False
    while len(codes) < len(running):
        for arm, process in running.items():
            if arm not in codes and process.poll() is not None:
                codes[arm] = process.returncode
                gate.leave(arm)
        if not began and gate.ready() and (args.hold is None or args.hold.exists()):
            began = True
            gate.begin()
        time.sleep(0.05)
    rows = []
    for arm in ARMS:
        if codes[arm] == 0:
            scored = _start("scored", out, arm, [*cpu, str(out / arm / "model"), args.lpips])
            codes[arm] = scored.wait()
        found = {"arm": arm, "exit code": codes[arm], "iterations": args.iterations}
        for name in ("turns", "scored"):
            path = out / f"{arm}.{name}.json"
            found.update(json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {})
        rows.append(found)
        (out / "rows.json").write_text(json.dumps(rows), encoding="utf-8")
    report(rows)
    return max(codes.values())


def _start(module: str, out: Path, arm: str, words: List[str]) -> subprocess.Popen[bytes]:
    """Start a file beside this one in an arm's copy; its report is OUT/ARM.MODULE.json."""
    script = Path(__file__).with_name(f"{module}.py")
    words = [str(out / arm / "model") if word == "MODEL" else word for word in words]
    search = [str(ROOT), str(ROOT / "adapters"), os.environ.get("PYTHONPATH", "")]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment["PYTHONPATH"] = os.pathsep.join(path for path in search if path)
    with open(out / f"{arm}.{module}.log", "wb") as log:
        return subprocess.Popen(
            [sys.executable, str(script), str(out / f"{arm}.{module}.json"), *words],
            cwd=str(out / arm),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        )


def report(rows: List[Dict[str, Any]]) -> None:
    """Print a table; the ratio is the median over turns of an arm's step to the first arm's in the same round."""
    first = rows[0].get("ms a step by turn", [])
    for row in rows:
        turns = row.get("ms a step by turn", [])
        ratios = [own / other for own, other in zip(turns[1:], first[1:])]  # the first turn compiles
        ratio = statistics.median(ratios) if ratios else float("nan")
        shown = {key: value for key, value in row.items() if key not in ("ms a step by turn", "views")}
        print(f"{row['arm']}: {ratio:.3f} of the first arm's step; {json.dumps(shown)}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
