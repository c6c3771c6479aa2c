"""The loss beside other implementations: time, memory, the weights alone, and how the cost grows. Writes JSON.

    python benchmarks/loss.py --threads 1 --size 1297x840
    python benchmarks/loss.py --parts growth
    python benchmarks/loss.py --parts threads --threads 2         # what they give, by the clock: a quiet machine
    python benchmarks/loss.py --device cuda --parts loss memory   # fused-ssim too, where it is installed

The contenders take turns in every round, on the same eight pairs of images and the same threads; a ratio is taken
within a round, and the table shows the median and the least and greatest of them. On one thread the processor's own
time counts. kornia, pytorch-msssim and torchmetrics are measured where they are installed. "3DGS" is Inria's
l1_loss + ssim: |a - b|.mean() and torch's SSIM, which tests/loss/test_ssim.py holds equal to theirs to the last bit.
torch.compile compiles the reference before it is timed. Contenders of more than two seconds get three rounds. On
a GPU a time is that of ten steps between two events, all launched before the first of them begins, so that it is the
GPU's own; what a step takes as Python launches it stands beside it, and what the bytes that must move would take at the
bandwidth of a copy.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Dict, List, Tuple

import torch
from losses.contenders import losses, weightings
from losses.images import images, some_images
from losses.machine import machine
from losses.tables import TOO_LONG, at_bandwidth, side_by_side
from losses.timing import timed

THREADED = ("LEGS, weights in the kernel", "LEGS, stored map", "3DGS by the kernel")
GROWTH = ((400, 266), (800, 533), (1297, 840), (1600, 1066), (3840, 2160), (7680, 4320))


def main() -> None:
    args = parse()
    if args.memory_of:  # a child: one contender in a process of its own
        print(json.dumps(peak_memory(args.memory_of, args.size, args.device)))
        return
    result: Dict[str, Any] = {
        "machine": machine(args.device),
        "threads": args.threads,
        "size": f"{args.size[0]}x{args.size[1]}",
    }
    for part in args.parts:
        result[part] = PARTS[part](args)
    if args.json:
        Path(args.json).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def loss(args: argparse.Namespace) -> Any:
    print(f"\nforward and backward, {args.size[0]}x{args.size[1]} RGB, {where(args)}")
    contenders = losses(some_images(args.size, args.device))
    if args.only:
        missing = [name for name in args.only if name not in contenders]
        if missing:
            sys.exit(f"loss.py: --only {missing[0]!r} is not here; these are: {', '.join(contenders)}")
        contenders = {name: contenders[name] for name in args.only}
    table = side_by_side(contenders, args.rounds, "LEGS, weights in the kernel", args.device)
    if args.device.type == "cuda":
        at_bandwidth(table, args.size, args.device)
    return table


def where(args: argparse.Namespace) -> str:
    return torch.cuda.get_device_name(args.device) if args.device.type == "cuda" else f"threads: {args.threads}"


def weights(args: argparse.Namespace) -> Any:
    print(f"\nthe weights alone, {args.size[0]}x{args.size[1]} RGB, {where(args)}")
    _, target = images(args.size, args.device)
    return side_by_side(weightings(target), args.rounds, "weight_map", args.device)


def memory(args: argparse.Namespace) -> Any:
    print(f"\npeak memory beyond the images, forward and backward, {args.size[0]}x{args.size[1]} RGB")
    found = {}
    for name in args.only or losses([images((32, 32), args.device)]):
        command = [sys.executable, __file__, "--memory-of", name, "--threads", str(args.threads)]
        command += ["--device", str(args.device)]
        command += ["--size", f"{args.size[0]}x{args.size[1]}"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:  # torch.compile does not take every shape everywhere
            print(f"{name:<34} did not run: {done.stderr.strip().splitlines()[-1][:200]}", flush=True)
            continue
        found[name] = json.loads(done.stdout)
        print(f"{name:<34} {found[name] / 1e6:9.0f} MB", flush=True)
    return found


def growth(args: argparse.Namespace) -> Any:
    print(
        f"\nhow the cost grows, forward and backward; nothing is measured beyond a size where it took {TOO_LONG:.0f} s"
    )
    left = {"LEGS, weights in the kernel", "3DGS (torch)", "kornia SSIM + L1", "pytorch-msssim SSIM + L1"}
    found = []
    for size in GROWTH:
        contenders = losses([images(size, args.device)])
        for name in [name for name in contenders if name in left and (not args.only or name in args.only)]:
            row: Dict[str, Any] = {"size": f"{size[0]}x{size[1]}", "megapixels": size[0] * size[1] / 1e6, "name": name}
            for threads in sorted({1, os.cpu_count() or 1}) if args.device.type == "cpu" else (1,):
                torch.set_num_threads(threads)
                first = timed(contenders[name], args.device)
                rounds = 1 if first > 1.0 else args.rounds
                seconds = statistics.median(timed(contenders[name], args.device) for _ in range(rounds))
                row[f"ms on {threads}"] = 1e3 * seconds
                row[f"ns a pixel on {threads}"] = 1e9 * seconds / (size[0] * size[1])
                if seconds > TOO_LONG:
                    left.discard(name)
            found.append(row)
            values = "  ".join(f"{key} {value:.4g}" for key, value in row.items() if isinstance(value, float))
            print(f"{row['size']:<10} {name:<28} {values}", flush=True)
    torch.set_num_threads(args.threads)
    return found


def threads(args: argparse.Namespace) -> Any:
    """Time our steps on one thread and on several in turns, all by the clock; print how many times faster they are."""
    print(f"\nwhat {args.threads} threads give, forward and backward, {args.size[0]}x{args.size[1]} RGB")
    found = {}
    for name, step in losses(some_images(args.size, args.device)).items():
        if name not in (args.only or THREADED):
            continue
        rounds: Dict[int, List[float]] = {1: [], args.threads: []}
        for _ in range(args.rounds + 1):
            for count, seconds in rounds.items():
                torch.set_num_threads(count)
                before = time.perf_counter()
                step()
                seconds.append(time.perf_counter() - before)
        one, several = (1e3 * statistics.median(seconds[1:]) for seconds in rounds.values())
        gains = sorted(a / b for a, b in zip(rounds[1][1:], rounds[args.threads][1:]))
        found[name] = {"ms": [one, several], "gain": [statistics.median(gains), gains[0], gains[-1]]}
        spread = f"{statistics.median(gains):.2f} ({gains[0]:.2f} to {gains[-1]:.2f})"
        print(f"{name:<34} {one:7.2f} ms   {several:7.2f} ms   {spread}", flush=True)
    return found


def peak_memory(name: str, size: Tuple[int, int], device: torch.device) -> int:
    """Return by how many bytes one step raises this process's peak (on Linux); a small one came first, to load all.

    Of a GPU it is the peak of what torch allocated there.
    """
    losses([images((64, 64), device)])[name]()
    step = losses([images(size, device)])[name]
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        allocated = torch.cuda.memory_allocated(device)
        step()
        return torch.cuda.max_memory_allocated(device) - allocated
    ctypes.CDLL(None).malloc_trim(0)  # what is free already would hide what the step takes
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")  # the peak counts from here
    before = peak()
    step()
    return peak() - before


def peak() -> int:
    with open("/proc/self/status", encoding="ascii") as file:
        return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmHWM"))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", default=["loss", "weights", "memory", "growth"])
    parser.add_argument("--size", default="1297x840", type=lambda text: tuple(int(side) for side in text.split("x")))
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="cpu (the default) or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--json", help="write everything to this file")
    parser.add_argument("--only", nargs="+", help="measure only these contenders, in place of all")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.device.type == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no CUDA GPU here")
    torch.set_num_threads(args.threads)
    return args


PARTS = {"loss": loss, "weights": weights, "memory": memory, "growth": growth, "threads": threads}


if __name__ == "__main__":
    main()
