"""The loss beside what people run today: time, memory, the weights alone, and how the cost grows. Writes JSON.

    python benchmarks/loss.py --threads 1 --size 1297x840
    python benchmarks/loss.py --parts growth
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
import itertools
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence, Tuple

import torch
from torch import Tensor

from legs_loss import legs_loss, weight_map
from legs_loss.kernels.backends import backend_for, finding
from legs_loss.kernels.contract import Weights
from legs_loss.spec import PRESETS
from legs_loss.ssim import ssim_map

LAMBDA = 0.2
LEGS = PRESETS["legs"]
GROWTH = ((400, 266), (800, 533), (1297, 840), (1600, 1066), (3840, 2160), (7680, 4320))
SLOW_ROUNDS = 3
TOO_LONG = 2.0  # seconds
STEPS = 10  # between two events of a GPU
LONGEST_WAIT = 1.0  # seconds
FASTEST_CLOCK = 3e9  # of any GPU, in cycles a second: a slower one waits longer
COPIED = 1 << 28  # bytes
# The least bytes a value, and a pixel: prediction and target are read, the gradient is written. Weights from the kernel
# take another pass over the target; a stored map is read.
LEAST = (12, 0)
MUST_MOVE = {"LEGS, weights in the kernel": (16, 0), "LEGS, stored map": (12, 4)}

PAIRS = 8  # of images that take turns: one alone would stay in a GPU's cache, which no training's does
Contenders = Dict[str, Callable[[], Any]]
Loss = Callable[[Tensor, Tensor, Tensor], Tensor]  # of prediction, target and the target's weight map
Pairs = Sequence[Tuple[Tensor, Tensor]]


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
        result[part] = {"loss": loss, "weights": weights, "memory": memory, "growth": growth}[part](args)
    if args.json:
        Path(args.json).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def loss(args: argparse.Namespace) -> Any:
    print(f"\nforward and backward, {args.size[0]}x{args.size[1]} RGB, {where(args)}")
    contenders = losses(some_images(args.size, args.device))
    if args.only:
        contenders = {name: contenders[name] for name in args.only}
    table = side_by_side(contenders, args.rounds, "LEGS, weights in the kernel", args.device)
    if args.device.type == "cuda":
        at_bandwidth(table, args.size, args.device)
    return table


def where(args: argparse.Namespace) -> str:
    return torch.cuda.get_device_name(args.device) if args.device.type == "cuda" else f"threads: {args.threads}"


def copy_bandwidth(device: torch.device) -> float:
    """Return how many bytes a second a copy on the device moves, read and written."""
    source = torch.empty(COPIED, dtype=torch.uint8, device=device)
    copy = torch.empty_like(source)
    return 2 * COPIED / statistics.median(timed(lambda: copy.copy_(source), device) for _ in range(9))


def at_bandwidth(table: Dict[str, Any], size: Tuple[int, int], device: torch.device) -> None:
    """Add to the rows, and print, the bytes that must move at least, and their share of the bandwidth of a copy."""
    bandwidth = copy_bandwidth(device)
    print(f"a copy moves {bandwidth / 1e9:.0f} GB/s")
    for name, row in table.items():
        (of_value, of_pixel), pixels = MUST_MOVE.get(name, LEAST), size[0] * size[1]
        row["bytes"] = (3 * of_value + of_pixel) * pixels
        least = 1e3 * row["bytes"] / bandwidth
        row["ms at a copy's bandwidth"], row["share of a copy's bandwidth"] = least, least / row["median ms"]
        megabytes, share = row["bytes"] / 1e6, row["share of a copy's bandwidth"]
        print(f"{name:<46} {megabytes:10.1f} MB   at that {least:.3f} ms, {share:.2f} of its time")


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
                set_threads(threads)
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
    set_threads(args.threads)
    return found


def losses(pairs: Pairs) -> Contenders:
    """Return each loss as a function that computes it and its gradient, each time of the next pair of images."""
    stored = [weight_map(target, LEGS) for _, target in pairs]
    device = pairs[0][0].device

    def l1(image: Tensor, target: Tensor) -> Tensor:
        return torch.abs(image - target).mean()

    def mixed(similarity: Callable[[Tensor, Tensor], Tensor]) -> Loss:
        return lambda image, target, _: (1.0 - LAMBDA) * l1(image, target) + LAMBDA * (1.0 - similarity(image, target))

    def batched(similarity: Callable[..., Tensor], *rest: Any, **settings: Any) -> Callable[[Tensor, Tensor], Tensor]:
        return lambda image, target: similarity(image.unsqueeze(0), target.unsqueeze(0), *rest, **settings)

    contenders: Dict[str, Loss] = {}
    backend = backend_for(device)
    kernel = finding(backend, device).backend if backend != "torch" else None
    if kernel is not None:
        contenders["LEGS, weights in the kernel"] = lambda image, target, _: legs_loss(image, target, LEGS)
        contenders["LEGS, stored map"] = lambda image, target, stored: legs_loss(image, target, weight=stored)
        contenders["3DGS by the kernel"] = lambda image, target, _: kernel.loss(image, target, Weights(), LAMBDA)
    contenders["LEGS by torch"] = lambda image, target, _: (
        (1.0 - LAMBDA) * (weight_map(target, LEGS) * torch.abs(image - target)).mean()
        + LAMBDA * (1.0 - reference_ssim(image, target))
    )
    contenders["3DGS (torch)"] = mixed(reference_ssim)
    if device.type != "cuda":
        contenders["3DGS (torch, oneDNN off)"] = contenders["3DGS (torch)"]
    contenders["LEGS by torch.compile"] = torch.compile(contenders["LEGS by torch"])
    try:
        import kornia

        # kornia's value is (1 - SSIM) / 2
        half = batched(kornia.losses.ssim_loss, 11)
        contenders["kornia SSIM + L1"] = mixed(lambda image, target: 1.0 - 2.0 * half(image, target))
    except ImportError:
        pass
    try:
        import pytorch_msssim

        contenders["pytorch-msssim SSIM + L1"] = mixed(batched(pytorch_msssim.ssim, data_range=1.0))
    except ImportError:
        pass
    try:
        from torchmetrics.functional.image import structural_similarity_index_measure

        contenders["torchmetrics SSIM + L1"] = mixed(batched(structural_similarity_index_measure, data_range=1.0))
    except ImportError:
        pass
    try:
        from fused_ssim import fused_ssim

        if device.type == "cuda":
            alone = batched(fused_ssim)
            contenders["fused-ssim alone"] = lambda image, target, _: 1.0 - alone(image, target)
            contenders["fused-ssim + L1"] = mixed(alone)
    except ImportError:
        pass

    def switched(name: str, function: Loss) -> Callable[[Tensor, Tensor, int], Tensor]:
        def loss(image: Tensor, target: Tensor, i: int) -> Tensor:
            torch.backends.mkldnn.enabled = name != "3DGS (torch, oneDNN off)"  # type: ignore[assignment]
            return function(image, target, stored[i])

        return loss

    return {name: in_turns(pairs, switched(name, function)) for name, function in contenders.items()}


def in_turns(pairs: Pairs, loss: Callable[[Tensor, Tensor, int], Tensor]) -> Callable[[], None]:
    """Return a function that computes a loss and its gradient, each time of the next pair, which is the i-th."""
    turn = itertools.cycle(range(len(pairs)))

    def run() -> None:
        i = next(turn)
        image, target = pairs[i]
        image.grad = None
        loss(image, target, i).backward()

    return run


def reference_ssim(image: Tensor, target: Tensor) -> Tensor:
    """3DGS's own SSIM: torch's, whatever backend computes :func:`legs_loss.ssim`."""
    return ssim_map(image, target).mean()


def weightings(target: Tensor) -> Contenders:
    """Return each way to the weights of a photograph as a function."""
    found: Contenders = {"weight_map": lambda: weight_map(target, LEGS)}
    if not target.is_cuda and finding("numba", target.device).backend is not None:
        from legs_loss.kernels.numba_passes import extremes

        batch = target.unsqueeze(0).numpy()
        found["its extremes by numba (all the kernel keeps)"] = lambda: extremes(batch, LEGS)
    try:
        import kornia

        def by_kornia() -> Tensor:
            values = kornia.filters.laplacian(target.unsqueeze(0), 3, border_type="reflect", normalized=False)
            strength = values.norm(dim=1, keepdim=True)
            low, high = strength.amin(), strength.amax()
            return 1.0 + LEGS.beta * torch.sqrt((strength - low) / (high - low + LEGS.eps))

        found["kornia.filters.laplacian + the same"] = by_kornia
    except ImportError:
        pass
    return found


def side_by_side(contenders: Contenders, rounds: int, against: str, device: torch.device) -> Any:
    """Time all contenders in turns; print and return medians and the ratios to one of them."""
    first = {}
    for name, step in list(contenders.items()):
        try:
            first[name] = timed(step, device)  # compilation, and memory's first touch
        except Exception as error:  # torch.compile needs a C++ compiler and raises nearly anything
            print(f"{name}: it does not run here ({type(error).__name__}: {str(error).strip().splitlines()[0]})")
            del contenders[name]
    times: Dict[str, List[float]] = {name: [] for name in contenders}
    for i in range(rounds):
        for name, step in contenders.items():
            if i < SLOW_ROUNDS or first[name] < 2.0:
                times[name].append(timed(step, device))
    table = {}
    against = against if against in times else next(iter(times))
    digits = 4 if device.type == "cuda" else 2
    for name, seconds in times.items():
        ratios = [ours / theirs for ours, theirs in zip(times[against], seconds)]
        table[name] = {
            "ms": [1e3 * value for value in seconds],
            "median ms": 1e3 * statistics.median(seconds),
            f"ratio of {against!r} to it": [statistics.median(ratios), min(ratios), max(ratios)],
        }
        spread = f"{statistics.median(ratios):7.4f}  ({min(ratios):.4f} to {max(ratios):.4f})"
        print(f"{name:<46} {1e3 * statistics.median(seconds):10.{digits}f} ms   ours / it {spread}", flush=True)
        if device.type == "cuda":
            launched = statistics.median(as_launched(contenders[name], device) for _ in range(SLOW_ROUNDS))
            table[name]["ms as launched"] = 1e3 * launched
            print(f"{'':<46} {1e3 * launched:10.{digits}f} ms as Python launches it", flush=True)
    return table


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


def images(size: Tuple[int, int], device: torch.device) -> Tuple[Tensor, Tensor]:
    """Return a prediction that learns and a target: a picture of waves with noise, 8 bits deep as photographs are."""
    width, height = size
    generator = torch.Generator().manual_seed(0)
    x, y = torch.arange(float(width)) / 37.0, torch.arange(float(height))[:, None] / 23.0
    waves = torch.stack([0.5 + 0.3 * torch.sin((k + 1) * x + torch.cos(y * (k + 1))) for k in range(3)])
    target = (waves + 0.05 * torch.randn(3, height, width, generator=generator)).clamp(0.0, 1.0)
    target = (255.0 * target).round() / 255.0
    prediction = 0.9 * target + 0.05 * torch.rand(3, height, width, generator=generator)
    return prediction.to(device).requires_grad_(), target.to(device)


def some_images(size: Tuple[int, int], device: torch.device) -> Pairs:
    """Return pairs of images that differ."""
    prediction, target = images(size, device)
    return [(prediction.detach().roll(31 * i, -1).requires_grad_(), target.roll(31 * i, -1)) for i in range(PAIRS)]


def timed(step: Callable[[], Any], device: torch.device) -> float:
    """Return the seconds of a step: on one thread the processor's own, which other people's work hardly changes."""
    if device.type == "cuda":
        step()  # what is compiled or allocated now is not timed
        return between_events(step, as_launched(step, device))
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    before = clock()
    step()
    return clock() - before


def as_launched(step: Callable[[], Any], device: torch.device) -> float:
    """Return the seconds of a step on a GPU as Python launches it: of a small image, launching takes longest."""
    torch.cuda.synchronize(device)
    before = time.perf_counter()
    for _ in range(STEPS):
        step()
    torch.cuda.synchronize(device)
    return (time.perf_counter() - before) / STEPS


def between_events(step: Callable[[], Any], launched: float) -> float:
    """Return the seconds of a step on a GPU alone: the GPU is kept busy until all steps are launched, then timed."""
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda._sleep(int(min(2.0 * launched * STEPS, LONGEST_WAIT) * FASTEST_CLOCK))
    start.record()
    for _ in range(STEPS):
        step()
    end.record()
    end.synchronize()
    return start.elapsed_time(end) / 1e3 / STEPS


def set_threads(threads: int) -> None:
    torch.set_num_threads(threads)
    try:
        import numba

        numba.set_num_threads(threads)
    except ImportError:
        pass


def machine(device: torch.device) -> Dict[str, str]:
    """Return what the numbers depend on."""
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            name = next((line.split(":")[1].strip() for line in file if line.startswith("model name")), name)
    versions = {"python": platform.python_version(), "torch": torch.__version__}
    if device.type == "cuda":
        versions["gpu"], versions["cuda"] = torch.cuda.get_device_name(device), str(torch.version.cuda)
    for package in ("numba", "fused_ssim", "kornia", "pytorch_msssim", "torchmetrics"):
        try:
            versions[package] = str(getattr(__import__(package), "__version__", "installed"))
        except ImportError:
            versions[package] = "not installed"
    return {"processor": name, "cores": str(os.cpu_count()), **versions}


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
    set_threads(args.threads)
    return args


if __name__ == "__main__":
    main()
