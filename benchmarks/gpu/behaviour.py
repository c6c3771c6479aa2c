"""The kernels' behaviour: they wait for nothing, and run in graphs, on any stream and under torch.compile.

On the CPU the same steps run without the graph or the stream, and a stage says that the rest needs CUDA.
"""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any, Callable, Iterator, Sequence, Tuple

import torch
from torch import Tensor

from benchmarks.gpu.options import Options, Record, Skipped
from benchmarks.losses.images import images, some_images
from legs_loss import configure, l1_loss, legs_loss, ssim

__all__ = ["compile", "graph", "stream", "synchronisation"]

BUSY = 10**8  # cycles: some fiftieth of a second
Step = Callable[[], Tuple[Tensor, ...]]


def synchronisation(options: Options, record: Record) -> None:
    """Run steps while torch raises an error for every wait for the device."""
    device = options.device()
    configure("legs")
    pairs = some_images((400, 300), device)[:3]
    ones = torch.ones(300, 400, device=device)
    steps = {
        "legs_loss": lambda image, target: legs_loss(image, target),
        "legs_loss, eggs": lambda image, target: legs_loss(image, target, "eggs"),
        "legs_loss, stored map": lambda image, target: legs_loss(image, target, weight=ones),
        "l1_loss and ssim": lambda image, target: 0.8 * l1_loss(image, target) + 0.2 * (1.0 - ssim(image, target)),
    }
    for name, step in steps.items():
        step(*pairs[0]).backward()  # compiles and loads
        with _waits_are_errors(device):
            for image, target in pairs:  # the second and third are new to the memory of views
                step(image, target).backward()
        record(**{name: _found(device, "nothing waited for the device")})
    _only_rehearsed(device, "torch reports a wait for a GPU only")


def graph(options: Options, record: Record) -> None:
    """Capture a step in a CUDA graph, replay it with other pixels, and compare with the step itself."""
    device = options.device()
    configure("legs")
    for name, loss in (("legs_loss", legs_loss), ("l1_loss", l1_loss)):
        image, target = images((400, 300), device)
        step = _step(loss, image, target)
        found, replay = _captured(step, device)
        with torch.no_grad():
            target.copy_(target.flip(-1))
            image.mul_(0.9)
        replay()
        _must_equal(found, step(), f"{name}, replayed with other pixels")
        record(**{name: _found(device, "a replay with other pixels is equal to the last bit")})
    _only_rehearsed(device, "there are no graphs on the CPU")


def stream(options: Options, record: Record) -> None:
    """Compute on a second stream while the first one is busy, and compare."""
    device = options.device()
    configure("legs")
    for name, loss in (("legs_loss", legs_loss), ("l1_loss", l1_loss)):
        step = _step(loss, *images((1297, 840) if device.type == "cuda" else (130, 84), device))
        expected = step()
        with _second_stream(device):
            found = [step() for _ in range(10)]
        for each in found:
            _must_equal(each, expected, f"{name} on a second stream")
        record(**{name: _found(device, "value and gradient are equal to the last bit")})
    _only_rehearsed(device, "there is one stream on the CPU")


def compile(options: Options, record: Record) -> None:
    """Compile the losses with torch.compile(fullgraph=True), value and gradient, and compare with the eager ones."""
    device = options.device()
    configure("legs")
    for name, loss in (("legs_loss", legs_loss), ("l1_loss", l1_loss)):
        image, target = images((200, 150), device)
        expected = _step(loss, image, target)()
        found = _step(torch.compile(loss, fullgraph=True), image, target)()
        apart = [float((a - b).norm() / b.norm()) for a, b in zip(found, expected)]
        record(**{name: {"value apart": apart[0], "gradient apart": apart[1]}})
        if not max(apart) < 1e-3:
            raise AssertionError(f"{name}: value and gradient are {apart} apart from the eager ones")


def _step(loss: Callable[..., Tensor], image: Tensor, target: Tensor) -> Step:
    """Return a function that computes a loss and its gradient."""

    def step() -> Tuple[Tensor, ...]:
        value = loss(image, target)
        return (value.detach(), *torch.autograd.grad(value, image))

    return step


def _captured(step: Step, device: torch.device) -> Tuple[Tuple[Tensor, ...], Callable[[], Any]]:
    """Return a step's results, and a function that computes them anew in the same memory: on a GPU, by a graph."""
    if device.type != "cuda":
        found = step()
        return found, lambda: [kept.copy_(new) for kept, new in zip(found, step())]
    with _second_stream(device):  # as torch asks for before a capture
        for _ in range(3):
            step()
    captured = torch.cuda.CUDAGraph()
    with torch.cuda.graph(captured):
        found = step()
    return found, captured.replay


@contextmanager
def _second_stream(device: torch.device) -> Iterator[None]:
    if device.type != "cuda":
        yield
        return
    other = torch.cuda.Stream()
    other.wait_stream(torch.cuda.current_stream())
    torch.cuda._sleep(BUSY)  # on the first one: what relied on it would come too late
    with torch.cuda.stream(other):
        yield
    torch.cuda.current_stream().wait_stream(other)


@contextmanager
def _waits_are_errors(device: torch.device) -> Iterator[None]:
    if device.type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def _must_equal(found: Sequence[Tensor], expected: Sequence[Tensor], where: str) -> None:
    if not all(torch.equal(a, b) for a, b in zip(found, expected)):
        raise AssertionError(f"{where}: {found[0].item():.9g} in place of {expected[0].item():.9g}")


def _found(device: torch.device, words: str) -> str:
    return words if device.type == "cuda" else "its steps ran on the CPU"


def _only_rehearsed(device: torch.device, reason: str) -> None:
    if device.type != "cuda":
        raise Skipped(f"needs CUDA: {reason}")
