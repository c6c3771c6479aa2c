"""Count the warp instructions that the CUDA kernels execute for 32 values, from their machine code, without a GPU.

nvdisasm (`pip install nvidia-cuda-nvdisasm`) writes the instructions; the loops are the branches backwards. Of all ways
through a loop the shortest is counted of those that read and write what a step inside an image does: so no edge of an
image, and no slow path of a division. Counted is all that a step runs at 1080p RGB: every block of the streaming pass,
with the rows and columns that tiles repeat or that lie outside the image and with its beginning and end, and, where the
weights come from the target, the pass that makes responses and range. The two kernels of one block that add up are not.
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

from legs_loss.kernels.cuda.backend import THREADS, chunks_of, strip_of
from legs_loss.kernels.cuda.modules import PLAIN, Variant, options, source

__all__ = ["BUDGET", "Instruction", "Way", "counted", "disassembler", "pipe_of", "read", "shortest"]

ROWS, CHANNELS, HALO, SLOPES_AND_MOMENTS = 4, 3, 10, 7
PITCH = THREADS + 12
SIZE = (1080, 1920)


class Way(NamedTuple):
    """The work of a way through a loop: loads, square roots, accesses of shared memory (None: the most there are)."""

    loads: int
    roots: int = 0
    shared: Optional[int] = None


class Budget(NamedTuple):
    """The instructions that 32 values of RGB may take, and the aim: a change that needs more says why, here."""

    kernel: str
    step: Way
    with_range: bool
    most: float
    aim: float


BUDGET: Dict[str, Budget] = {
    "weights inside": Budget("legs_loss_gradient", Way(5 * ROWS, ROWS), True, 400.0, 410.0),
    "stored map": Budget("legs_loss_gradient", Way(5 * ROWS), False, 360.0, 380.0),
    "SSIM alone": Budget("legs_ssim_gradient", Way(4 * ROWS), False, 330.0, 330.0),
}
# A step above a strip, of which moments go in and nothing comes out.
LIGHT = Way(2 * ROWS, 0, 4 * ROWS)
RANGE = Variant(0, 1, 2)
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
    """An instruction: its name, of a branch the position of its target in the list, and whether it has a condition."""

    name: str
    target: Optional[int]
    conditional: bool = False


def disassembler() -> Optional[Path]:
    """Return the nvdisasm that lies in a package named nvidia, if one does."""
    found = (path for place in sys.path if place for path in Path(place).glob("nvidia/*/bin/nvdisasm*"))
    return next(found, None)


def read(text: str, kernel: str) -> List[Instruction]:
    """Return the instructions of a kernel from nvdisasm's output."""
    section = text.split(f".text.{kernel}:\n", 1)[1].split("\n\t.section", 1)[0]
    labels: Dict[str, int] = {}
    found: List[Tuple[str, Optional[str], bool]] = []
    for line in section.splitlines():
        label = _LABEL.match(line)
        if label:
            labels[label.group(1)] = len(found)
        instruction = _LINE.search(line)
        if instruction:
            _, predicate, name, operands = instruction.groups()
            target = _TARGET.search(operands)
            conditional = bool(predicate) or re.match(r"\s*!?U?P\d", operands) is not None
            found.append((name, target.group(1) if target else None, conditional))
    return [
        Instruction(name, labels.get(target) if target and name.startswith(("BRA", "CALL")) else None, conditional)
        for name, target, conditional in found
    ]


def pipe_of(name: str) -> str:
    """Return the unit that executes an instruction.

    >>> [pipe_of(name) for name in ("FFMA", "IMAD.MOV.U32", "LDS.128", "LDG.E", "BAR.SYNC", "MUFU.RCP")]
    ['fp32', 'integer', 'shared', 'global', 'barrier', 'special']
    """
    return next((pipe for pipe, names in _PIPES if name.startswith(names)), "integer")


def loops_of(instructions: Sequence[Instruction]) -> List[Tuple[int, int]]:
    """Return first and last instruction of each loop."""
    return [(each.target, i) for i, each in enumerate(instructions) if each.target is not None and each.target <= i]


def shortest(instructions: Sequence[Instruction], first: int, last: int, way: Way) -> Counter[str]:
    """Return how many instructions of each pipe the shortest way through a loop, from its first to its last, executes.

    Inner loops are run through once.
    """
    reached: Dict[int, Dict[Tuple[int, int, int, int], Tuple[int, Counter[str]]]] = {
        first: {(0, 0, 0, 0): (0, Counter())}
    }
    ends: Dict[Tuple[int, int, int, int], Tuple[int, Counter[str]]] = {}

    def go(to: Dict[Any, Any], key: Any, total: int, pipes: Counter[str]) -> None:
        if key not in to or total < to[key][0]:
            to[key] = (total, pipes)

    for i in range(first, last + 1):
        name, target, conditional = instructions[i]
        for (loads, roots, shared, stores), (total, pipes) in reached.pop(i, {}).items():
            if name.startswith(("CALL", "RET")) and target is None:  # to a label it is but a jump
                continue
            key = (
                loads + name.startswith("LDG"),
                roots + name.startswith("MUFU.SQRT"),
                shared + name.startswith(("LDS", "STS")),
                stores + name.startswith("STG"),
            )
            pipes = pipes + Counter([pipe_of(name)])
            following = [i + 1] if target is None or conditional else []
            following += [target] if target is not None and (target > i or target == first) else []
            for each in following:
                if each <= last:
                    go(ends if each == first else reached.setdefault(each, {}), key, total + 1, pipes)
    fits = [
        (-key[2], -key[3], total, pipes)
        for key, (total, pipes) in ends.items()
        if key[:2] == (way.loads, way.roots) and way.shared in (None, key[2])
    ]
    if not fits:
        raise SystemExit(f"no way through the loop does {way}")
    return min(fits, key=lambda fit: fit[:3])[3]


def plus(*parts: Tuple[float, Counter[str]]) -> Counter[str]:
    """Return the sum of counts, each taken some times."""
    total: Counter[str] = Counter()
    for times, counts in parts:
        for pipe, number in counts.items():
            total[pipe] += times * number
    return total


def around(instructions: Sequence[Instruction], first: int, last: int) -> Counter[str]:
    """Return what a kernel executes around its main loop: all there is, its loops as often as they run."""
    times = [1.0] * len(instructions)
    for start, end in loops_of(instructions):
        if end < first or start > last:
            body = [each.name for each in instructions[start : end + 1]]
            words = sum(4 if name.endswith(".128") else 1 for name in body if name.startswith("STS"))
            sums = any(name.startswith("BAR") for name in body)
            trips = THREADS.bit_length() - 1 if sums else SLOPES_AND_MOMENTS * ROWS * PITCH / THREADS
            for i in range(start, end + 1):
                times[i] = trips / words if words else 1.0
    found: Counter[str] = Counter()
    for i, each in enumerate(instructions):
        if not first <= i <= last:
            found[pipe_of(each.name)] += times[i]
        if each.name.startswith("EXIT") and not each.conditional and i > last:
            break
    return found


def streaming(instructions: Sequence[Instruction], step: Way) -> Counter[str]:
    """Return the warp instructions of all blocks of the streaming pass, by pipe."""
    images = torch.empty(1, CHANNELS, *SIZE, device="meta")
    strip, blocks = strip_of(images, CARDS["H200"][0], True)
    rows = [min(strip, SIZE[0] - top) for top in range(0, SIZE[0], strip)]
    main = max(loops_of(instructions), key=lambda loop: loop[1] - loop[0])
    light = 2  # of the 2 * HALO / ROWS steps more than a strip has; one more ends it, in part
    steps = sum(-(-(each + 2 * HALO) // ROWS) + 1 - light for each in rows)
    per_column = blocks / len(rows) * THREADS / 32
    return plus(
        (per_column * steps, shortest(instructions, *main, step)),
        (per_column * light * len(rows), shortest(instructions, *main, LIGHT)),
        (per_column * len(rows), around(instructions, *main)),
    )


def pixelwise(instructions: Sequence[Instruction]) -> Counter[str]:
    """Return the warp instructions of all blocks that make responses, by the shorter of their loops over channels."""
    images = torch.empty(1, CHANNELS, *SIZE, device="meta")
    inner = [
        loop for loop in loops_of(instructions) if any(x.name.startswith("LDG") for x in instructions[slice(*loop)])
    ]
    first, last = min(inner, key=lambda loop: loop[1] - loop[0])
    loads = sum(each.name.startswith("LDG") for each in instructions[first : last + 1])
    others = [i for loop in inner if loop != (first, last) for i in range(loop[0], loop[1] + 1)]
    nothing = Instruction("NOP", None)
    rest = around([nothing if i in others else each for i, each in enumerate(instructions)], first, last)
    rest["control"] -= len(others)
    warps = chunks_of(images) * THREADS / 32
    return plus((warps * CHANNELS, shortest(instructions, first, last, Way(loads))), (warps, rest))


def counted(compiler: Any, architecture: int, nvdisasm: Path) -> Dict[str, Dict[str, float]]:
    """Return of each row of BUDGET the warp instructions for 32 values, by pipe, their "total" and "range"."""
    texts = {}
    for variant in (PLAIN, RANGE):
        binary = compiler.compile(source(), options(variant), f"sm_{architecture}")[0]
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(binary)
            file.flush()
            done = subprocess.run([str(nvdisasm), "-c", file.name], capture_output=True, text=True, check=True)
        texts[variant] = done.stdout
    share = 32.0 / (CHANNELS * SIZE[0] * SIZE[1])
    responses = pixelwise(read(texts[RANGE], "legs_range"))
    found: Dict[str, Dict[str, float]] = {}
    for name, budget in BUDGET.items():
        by_pipe = streaming(read(texts[PLAIN], budget.kernel), budget.step)
        whole = plus((share, by_pipe), (share * budget.with_range, responses))
        found[name] = {**dict(sorted(whole.items())), "total": sum(whole.values())}
        found[name]["range"] = share * budget.with_range * sum(responses.values())
    return found


def report(compiler: Any, architecture: int, nvdisasm: Path) -> Tuple[Dict[str, Dict[str, float]], List[str]]:
    """Print the counts of a GPU with their bounds; return them, and the names of those above their budget."""
    table = counted(compiler, architecture, nvdisasm)
    values = CHANNELS * SIZE[0] * SIZE[1]
    for name, row in table.items():
        pipes = "  ".join(f"{pipe} {number:.0f}" for pipe, number in row.items() if pipe not in ("total", "range"))
        bounds = "  ".join(
            f"{card}: issue {1e6 * row['total'] * values / 32 / (4 * processors * clock):.0f} us, "
            f"memory {1e6 * 12 * values / bandwidth:.0f} us"
            for card, (processors, clock, bandwidth) in CARDS.items()
        )
        aim = BUDGET[name].aim
        print(f"sm_{architecture} {name:<15} {row['total']:.0f} for 32 values (aim {aim:.0f})  {pipes}")
        print(f"{'':<21} of these the responses' pass {row['range']:.0f}; 1080p RGB, {bounds}", flush=True)
    return table, [name for name, row in table.items() if row["total"] > BUDGET[name].most]
