"""Count the warp instructions that the CUDA kernels execute for 32 values, from their machine code, without a GPU.

nvdisasm (`pip install nvidia-cuda-nvdisasm`) writes the instructions; the loops are the branches backwards. The longest
loop with barriers is a step of the streaming pass: it is counted as it runs inside an image, each inner loop as often
as the source says, without the blocks that end in a call, which are the slow paths of divisions. The passes over single
pixels (range, weights) come on top, once for all channels, and are not counted.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Optional, Sequence, Tuple

import torch

from legs_loss.kernels.cuda.backend import THREADS, strip_of
from legs_loss.kernels.cuda.modules import Variant, options, source

__all__ = ["BUDGET", "Instruction", "counted", "disassembler", "executed", "pipe_of", "read"]

ROWS, CHANNELS, HALO = 4, 3, 10
SIZE = (1080, 1920)
# What 32 values of RGB may take at most, by variant and kernel: a change that needs more says why, here.
BUDGET: Dict[str, Tuple[Variant, str, float]] = {
    "whole loss": (Variant(0), "legs_loss_gradient", 450.0),
    "SSIM alone": (Variant(0), "legs_ssim_gradient", 425.0),
}
AIMS = {"whole loss": 380.0, "SSIM alone": 330.0}
# Multiprocessors, cycles a second, bytes a second; each of four schedulers issues one instruction a cycle.
CARDS = {"H200": (132, 1.83e9, 4.8e12), "RTX 4090": (128, 2.52e9, 1.01e12)}

_LINE = re.compile(r"/\*([0-9a-f]+)\*/\s+(@!?U?P\d+\s+)?([A-Z0-9_.]+)(.*?);")
_LABEL = re.compile(r"^(\.L_x_\d+):")
_TARGET = re.compile(r"`\((\.L_x_\d+)\)")
_PIPES = (
    ("shared", ("LDS", "STS")),
    ("global", ("LDG", "STG", "LD.", "ST.")),
    ("barrier", ("BAR",)),
    ("special", ("MUFU",)),
    ("fp32", ("FADD", "FMUL", "FFMA", "FSETP", "FSEL", "FMNMX", "FCHK")),
    ("control", ("BRA", "BSSY", "BSYNC", "EXIT", "CALL", "RET", "WARPSYNC", "NOP", "BREAK", "YIELD")),
)


class Instruction(NamedTuple):
    """An instruction of a kernel: its name, and for a branch the position of its target in the list."""

    name: str
    target: Optional[int]


def disassembler() -> Optional[Path]:
    """Return the nvdisasm that lies in a package named nvidia, if one does."""
    found = (path for place in sys.path if place for path in Path(place).glob("nvidia/*/bin/nvdisasm*"))
    return next(found, None)


def read(text: str, kernel: str) -> List[Instruction]:
    """Return the instructions of a kernel from nvdisasm's output."""
    section = text.split(f".text.{kernel}:\n", 1)[1].split("\n\t.section", 1)[0]
    labels: Dict[str, int] = {}
    found: List[Tuple[str, Optional[str]]] = []
    for line in section.splitlines():
        label = _LABEL.match(line)
        if label:
            labels[label.group(1)] = len(found)
        instruction = _LINE.search(line)
        if instruction:
            target = _TARGET.search(instruction.group(4))
            found.append((instruction.group(3), target.group(1) if target else None))
    return [
        Instruction(name, labels.get(target) if target and name.startswith("BRA") else None) for name, target in found
    ]


def pipe_of(name: str) -> str:
    """Return the unit that executes an instruction.

    >>> [pipe_of(name) for name in ("FFMA", "IMAD.MOV.U32", "LDS.128", "LDG.E", "BAR.SYNC", "MUFU.RCP")]
    ['fp32', 'integer', 'shared', 'global', 'barrier', 'special']
    """
    return next((pipe for pipe, names in _PIPES if name.startswith(names)), "integer")


def executed(instructions: Sequence[Instruction]) -> Counter[str]:
    """Return how many instructions of each pipe a warp executes in a step of the streaming pass."""
    loops = [(each.target, i) for i, each in enumerate(instructions) if each.target is not None and each.target <= i]
    steps = [(first, last) for first, last in loops if _has(instructions[first : last + 1], "BAR")]
    first, last = max(steps, key=lambda loop: loop[1] - loop[0])
    times = [1.0] * len(instructions)
    inner = sorted({loop for loop in loops if first <= loop[0] and loop[1] <= last and loop != (first, last)})
    for start, end in inner:
        body = instructions[start : end + 1]
        # Rows of a blur: the body has as many as it writes values.
        trips = 1.0 if _has(body, "BAR") else ROWS / max(1, sum(each.name.startswith("STG") for each in body))
        for i in range(start, end + 1):
            times[i] *= trips
    for i in _slow(instructions, first, last):
        times[i] = 0.0
    found: Counter[str] = Counter()
    for i in range(first, last + 1):
        found[pipe_of(instructions[i].name)] += times[i]
    return found


def _has(instructions: Sequence[Instruction], name: str) -> bool:
    return any(each.name.startswith(name) for each in instructions)


def _slow(instructions: Sequence[Instruction], first: int, last: int) -> List[int]:
    """Return the positions in blocks that end in a call: the slow paths of divisions and roots."""
    leaders = {first, *(each.target for each in instructions[first : last + 1] if each.target is not None)}
    leaders |= {i + 1 for i in range(first, last) if instructions[i].target is not None}
    slow: List[int] = []
    block: List[int] = []
    calls = False
    for i in range(first, last + 2):
        if i in leaders or i > last:
            slow += block if calls else []
            block, calls = [], False
        if i <= last:
            block.append(i)
            calls = calls or instructions[i].name.startswith("CALL")
    return slow


def counted(compiler: Any, architecture: int, nvdisasm: Path) -> Dict[str, Dict[str, float]]:
    """Return of each row of BUDGET the warp instructions for 32 values at 1080p RGB, by pipe, and their "total"."""
    images = torch.empty(1, CHANNELS, *SIZE, device="meta")
    strip, _ = strip_of(images, CARDS["H200"][0], True)
    # A step is ROWS rows of a tile, whose core is what remains of it; a strip repeats the rows above and below it.
    share = 32.0 * (THREADS / 32) / (ROWS * (THREADS - 2 * HALO)) * (strip + 2 * HALO) / strip
    found: Dict[str, Dict[str, float]] = {}
    for name, (variant, kernel, _) in BUDGET.items():
        binary = compiler.compile(source(), options(variant), f"sm_{architecture}").binary
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(binary)
            file.flush()
            done = subprocess.run([str(nvdisasm), "-c", file.name], capture_output=True, text=True, check=True)
        by_pipe = executed(read(done.stdout, kernel))
        found[name] = {pipe: share * number for pipe, number in sorted(by_pipe.items())}
        found[name]["total"] = sum(found[name].values())
    return found


def report(compiler: Any, architecture: int, nvdisasm: Path) -> Tuple[Dict[str, Dict[str, float]], List[str]]:
    """Print the counts of a GPU with their bounds; return them, and the names of those above their budget."""
    table = counted(compiler, architecture, nvdisasm)
    values = CHANNELS * SIZE[0] * SIZE[1]
    for name, row in table.items():
        pipes = "  ".join(f"{pipe} {number:.0f}" for pipe, number in row.items() if pipe != "total")
        bounds = "  ".join(
            f"{card}: issue {1e6 * row['total'] * values / 32 / (4 * processors * clock):.0f} us, "
            f"memory {1e6 * 12 * values / bandwidth:.0f} us"
            for card, (processors, clock, bandwidth) in CARDS.items()
        )
        print(f"sm_{architecture} {name:<15} {row['total']:.0f} for 32 values (aim {AIMS[name]:.0f})  {pipes}")
        print(f"{'':<21} 1080p RGB, {bounds}", flush=True)
    return table, [name for name, row in table.items() if row["total"] > BUDGET[name][2]]
