"""Everything that needs a GPU, in one command of at most 25 minutes; what it has is kept when it is interrupted.

    python benchmarks/gpu.py --json gpu.json
    python benchmarks/gpu.py --training fastgs/train.py -s fox --iterations 3000     # and a training, plain and LEGS
    python benchmarks/gpu.py --emulate --sizes 40x30                                 # its rehearsal on a CPU, with g++

Each stage is written to the file when it ends; one that fails is recorded and the next one begins. The times are those
of benchmarks/loss.py: contenders in turns, eight pairs of images, medians. With --emulate the kernels are compiled with
g++ and run on the CPU, which tries this script; its times mean nothing, and what only a GPU has is skipped.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable, Dict

import torch

from benchmarks import loss as timing
from legs_loss import legs_loss, weight_map
from legs_loss.kernels import backends
from legs_loss.kernels.contract import Weights
from legs_loss.spec import PRESETS

SIZES = ("800x533", "1297x840", "1920x1080", "3840x2160")
SHAPES = ((3, 1, 1), (1, 5, 7), (3, 44, 45), (2, 3, 30, 47), (4, 90, 3), (3, 137, 251), (1, 300, 109))
LEGS = PRESETS["legs"]
CLOSE = 1e-4  # of float64's value and of its gradient's norm


def main() -> int:
    args = parse()
    if args.emulate:
        emulate()
    found: Dict[str, Any] = {}
    stages: Dict[str, Callable[[argparse.Namespace], Any]] = {
        "machine": machine,
        "agreement": agreement,
        **{f"times {size}": times_of(size) for size in args.sizes},
        "no synchronisation": no_synchronisation,
        "graph capture": graph_capture,
        "second stream": second_stream,
        "torch.compile": compiled,
        "training": training,
    }
    began = time.monotonic()
    for name, stage in stages.items():
        print(f"\n== {name}", flush=True)
        if time.monotonic() - began > 60 * args.minutes:
            found[name] = {"skipped": "the time is over"}
        else:
            try:
                found[name] = stage(args)
            except Skipped as reason:
                found[name] = {"skipped": str(reason)}
            except Exception as error:  # the other stages are worth having
                found[name] = {"failed": f"{type(error).__name__}: {error}"}
        print(json.dumps({key: value for key, value in found[name].items() if not key.startswith("table")}), flush=True)
        Path(args.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    failed = [name for name, result in found.items() if "failed" in result]
    print(f"\n{len(found) - len(failed)} stages of {len(found)} without a failure; written to {args.json}")
    return 1 if failed else 0


class Skipped(Exception):
    """A stage cannot be done here; the message says why."""


def machine(args: argparse.Namespace) -> Dict[str, Any]:
    result: Dict[str, Any] = dict(timing.machine(args.device), device=str(args.device))
    name = backends.backend_for(args.device)
    result["backend"] = f"{name}: {backends.finding('cuda', args.device).reason}"
    if name != "cuda":
        raise RuntimeError(f"the kernels are not used: {result['backend']}")
    source = torch.empty(timing.COPIED >> (6 if args.emulate else 0), dtype=torch.uint8, device=args.device)
    copy = torch.empty_like(source)
    seconds = sorted(timing.timed(lambda: copy.copy_(source), args.device) for _ in range(9))[4]
    return {**result, "GB/s of a copy": 2 * source.numel() / seconds / 1e9}


def agreement(args: argparse.Namespace) -> Dict[str, Any]:
    """Compare value and gradient with float64, for shapes and kinds of weight, and a repeat with the first."""
    worst = {"value": 0.0, "gradient": 0.0}
    for shape in SHAPES:
        target = torch.rand(shape)
        prediction = (0.8 * target + 0.1 * torch.rand(shape)).to(args.device).requires_grad_()
        target = target.to(args.device)
        for options in ({"spec": "3dgs", "weight": weight_map(target)}, {"spec": "legs"}, {"spec": "eggs"}):
            exact = prediction.detach().double().requires_grad_()
            weight = options.get("weight")
            expected = legs_loss(exact, target.double(), options["spec"], None if weight is None else weight.double())
            (reference,) = torch.autograd.grad(expected, exact)
            results = []
            for _ in range(2):
                value = legs_loss(prediction, target, options["spec"], weight)
                results.append((value.detach(), *torch.autograd.grad(value, prediction)))
            if not all(torch.equal(first, second) for first, second in zip(*results)):
                raise AssertionError(f"{shape} {options['spec']} does not repeat bit for bit")
            value, gradient = results[0]
            wanted = float(expected.detach())
            worst["value"] = max(worst["value"], abs(float(value) - wanted) / wanted)
            apart = float((gradient.double() - reference).norm() / reference.norm())
            worst["gradient"] = max(worst["gradient"], apart)
    if not max(worst.values()) < CLOSE:
        raise AssertionError(f"off by {worst}")
    return worst


def times_of(size: str) -> Callable[[argparse.Namespace], Dict[str, Any]]:
    shape = tuple(int(side) for side in size.split("x"))
    assert len(shape) == 2

    def stage(args: argparse.Namespace) -> Dict[str, Any]:
        pairs = timing.some_images(shape, args.device)
        contenders = timing.losses(pairs)
        contenders.pop("LEGS by torch.compile")  # takes minutes to compile
        add_l1(contenders, pairs)
        table = timing.side_by_side(contenders, args.rounds, "LEGS, weights in the kernel", args.device)
        if args.device.type == "cuda":
            timing.at_bandwidth(table, shape, args.device)
        return {"table": table}

    return stage


def add_l1(contenders: Any, pairs: Any) -> None:
    """Add the L1 alone: torch's plain one, and the weighted one as ``l1_loss`` computes it with a remembered range."""
    ranges = [backends.fused_range(target, LEGS) for _, target in pairs]
    turns = {"L1 alone (torch)": 0, "LEGS L1 alone, remembered range": 0}

    def plain(image: Any, target: Any, _: Any) -> Any:
        return torch.abs(image - target).mean()

    def weighted(image: Any, target: Any, kept: Any) -> Any:
        return backends.fused_l1(image, target, Weights(spec=LEGS, range=kept))

    def step(name: str, function: Any) -> Callable[[], None]:
        def run() -> None:
            turns[name] = (turns[name] + 1) % len(pairs)
            image, target = pairs[turns[name]]
            image.grad = None
            function(image, target, ranges[turns[name]]).backward()

        return run

    for name, function in zip(turns, (plain, weighted)):
        contenders[name] = step(name, function)


def no_synchronisation(args: argparse.Namespace) -> Dict[str, Any]:
    needs_gpu(args)
    image, target = timing.images((400, 300), args.device)
    legs_loss(image, target).backward()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for options in ({}, {"weight": torch.ones(300, 400, device=args.device)}, {"spec": "eggs"}):
            legs_loss(image, target, **options).backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return {"waits": 0}


def graph_capture(args: argparse.Namespace) -> Dict[str, Any]:
    """Capture a step and replay it with other pixels."""
    needs_gpu(args)
    image, target = timing.images((400, 300), args.device)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):
            torch.autograd.grad(legs_loss(image, target), image)
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        value = legs_loss(image, target)
        (gradient,) = torch.autograd.grad(value, image)
    with torch.no_grad():
        target.copy_(target.flip(-1))
        image.mul_(0.9)
    graph.replay()
    expected = legs_loss(image, target)
    (reference,) = torch.autograd.grad(expected, image)
    if not (torch.equal(value, expected) and torch.equal(gradient, reference)):
        raise AssertionError(f"replayed {value.item():g}, computed {expected.item():g}")
    return {"replay": "equal to the last bit"}


def second_stream(args: argparse.Namespace) -> Dict[str, Any]:
    needs_gpu(args)
    image, target = timing.images((1297, 840), args.device)
    expected = torch.autograd.grad(legs_loss(image, target), image)[0]
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        found = [torch.autograd.grad(legs_loss(image, target), image)[0] for _ in range(10)]
    torch.cuda.current_stream().wait_stream(stream)
    if not all(torch.equal(expected, gradient) for gradient in found):
        raise AssertionError("another gradient on another stream")
    return {"gradients": "equal to the last bit"}


def compiled(args: argparse.Namespace) -> Dict[str, Any]:
    needs_gpu(args)
    image, target = timing.images((200, 150), args.device)
    value = torch.compile(lambda first, second: legs_loss(first, second), fullgraph=True)(image, target)
    return {"apart": abs(value.item() - legs_loss(image, target).item())}


def training(args: argparse.Namespace) -> Dict[str, Any]:
    """Train twice with a codebase's own script, its loss plain and weighted: seconds, and the last PSNR it prints."""
    if not args.training:
        raise Skipped("no --training SCRIPT ARGUMENTS were given")
    result: Dict[str, Any] = {}
    for name, settings in (("plain", {"LEGS_OFF": "1"}), ("LEGS", {"LEGS_OFF": "0"})):
        command = [sys.executable, "-m", "legs_loss", "run", *args.training]
        before = time.monotonic()
        done = subprocess.run(command, env={**os.environ, **settings}, capture_output=True, text=True)
        seconds = time.monotonic() - before
        if done.returncode:
            raise RuntimeError(f"{name}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
        psnr = re.findall(r"PSNR\s*:?\s*([0-9.]+)", done.stdout + done.stderr)
        result[name] = {"seconds": seconds, "PSNR": float(psnr[-1]) if psnr else None}
    return result


def needs_gpu(args: argparse.Namespace) -> None:
    if args.device.type != "cuda":
        raise Skipped("only a GPU has that")


def emulate() -> None:
    """Put the kernels, compiled with g++, in the place of the CPU's backend."""
    from tests.cuda_emulation import COMPILER, emulated

    if COMPILER is None:
        raise SystemExit("--emulate needs g++")
    backends._KNOWN = {"cuda": ("tests.cuda_emulation", "cpu")}
    backends._findings["cuda cpu"] = backends.Finding(emulated(), True, "emulated")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", default="gpu.json", help="the file of results (default: %(default)s)")
    parser.add_argument("--sizes", nargs="+", default=SIZES)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--minutes", type=float, default=25, help="no stage begins later (default: %(default)s)")
    parser.add_argument("--emulate", action="store_true", help="on the CPU, with g++")
    parser.add_argument(
        "--training", nargs=argparse.REMAINDER, help="a training script and its arguments; the last option"
    )
    args = parser.parse_args()
    args.device = torch.device("cpu" if args.emulate else "cuda")
    if not args.emulate and not torch.cuda.is_available():
        parser.error("torch finds no CUDA GPU here (--emulate tries this script on the CPU)")
    return args


if __name__ == "__main__":
    sys.exit(main())
