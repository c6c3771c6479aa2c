"""The parts of an iteration of the trainer, each with its time and its bytes, of one checkout or of two side by side.

    PYTHONPATH=. python benchmarks/training.py SCENE RUN                  # RUN: a training's folder, with a checkpoint
    PYTHONPATH=. python benchmarks/training.py SCENE RUN --against DIR    # and before it another checkout's, in turns
    PYTHONPATH=. python benchmarks/training.py SCENE RUN --sparse_adam    # and before it the same without, in turns

Each round runs some iterations from the checkpoint, without density control, in a process of each; medians over all of
them, of the processor's time, or by the clock where there are several threads. The bytes of a part are what it has to
read and write once; what is written counts twice, since a processor reads it first. Beside them stands the time that a
copy takes for as many. A part near that is bound by memory, one far above it by operations, or by waiting for memory
that is read in no order.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import threading
import time
from pathlib import Path

PARTS = {
    "forward: checks": ("legs_loss.lab.rasterizer.rasterize", "_check_values"),
    "forward: projection": ("legs_loss.lab.rasterizer.projection", "project"),
    "forward: rows": ("legs_loss.lab.rasterizer.projection", "find_rows"),
    "forward: slots": ("legs_loss.lab.rasterizer.sorting", "make_slots"),
    "forward: sorting": ("legs_loss.lab.rasterizer.sorting", "sort_entries"),
    "forward: blending": ("legs_loss.lab.rasterizer.strips", "render"),
    "loss": ("legs_loss.lab.training.trainer", "step_loss"),
    "backward: sums": ("legs_loss.lab.rasterizer.sorting", "make_sums"),
    "backward: blending": ("legs_loss.lab.rasterizer.strips", "render_backward"),
    "backward: projection": ("legs_loss.lab.rasterizer.projection_backward", "project_backward"),
}
ADAM, REST, ALL = "Adam", "the rest (activations, autograd)", "an iteration"
JOINED = {  # of the parts above, what is one row of the table
    "forward: rows and sorting": ("forward: rows", "forward: slots", "forward: sorting"),
    "backward: blending": ("backward: sums", "backward: blending"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("run", type=Path)
    baselines = parser.add_mutually_exclusive_group()
    baselines.add_argument("--against", type=Path, metavar="DIR", help="another checkout: the baseline")
    baselines.add_argument("--sparse_adam", action="store_true", help="the dense one is the baseline")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--iterations", type=int, default=8, help="of a round")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--child", choices=("dense", "sparse"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        print(json.dumps(measure(args)))
        return
    here = Path(__file__).resolve().parents[1]
    contestants = [(here, "sparse" if args.sparse_adam else "dense")]
    if args.against is not None or args.sparse_adam:
        contestants.insert(0, (args.against.resolve() if args.against else here, "dense"))
    found = [[] for _ in contestants]
    for _ in range(args.rounds):
        for (tree, adam), results in zip(contestants, found):
            command = [sys.executable, __file__, *sys.argv[1:], "--child", adam]
            environment = dict(os.environ, PYTHONPATH=str(tree))
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            results.append(json.loads(done.stdout.splitlines()[-1]))
    show(args, found)


def measure(args):
    """Run iterations in this process: the milliseconds of each part, the facts of the scene, the speed of a copy."""
    import importlib

    import numpy as np
    import torch

    torch.set_num_threads(args.threads)
    from legs_loss.lab.rasterizer import sorting
    from legs_loss.lab.training import trainer
    from legs_loss.lab.training.checkpoint import read_state
    from legs_loss.lab.training.config import TrainConfig
    from legs_loss.lab.training.dataset import load_dataset
    from legs_loss.scenes import read_scene

    facts = read_state(args.run / "checkpoint.npz")[1]
    settings = dict(facts["config"], sparse_adam=True) if args.child == "sparse" else facts["config"]
    config = TrainConfig.from_dict(settings)
    data = load_dataset(read_scene(args.scene), config.weights, config.resolution, config.white_background)
    restored = TrainConfig.from_dict(facts["config"])
    run = trainer._TrainingState.restore(data, restored, args.run / "checkpoint.npz")
    run.config, run.schedule = config, run.schedule._replace(densify_from=1 << 30, reset_every=1 << 30)
    getattr(trainer, "keep_freed_memory", int)()  # older checkouts have none
    took, sizes = {}, {}
    clock = time.process_time if args.threads == 1 else time.perf_counter

    def timed(owner, name, part):
        function = getattr(owner, name)

        def call(*given, **named):
            if threading.current_thread() is not threading.main_thread():
                return function(*given, **named)  # what several threads do at once counts once
            begun = clock()
            result = function(*given, **named)
            took[part] = took.get(part, 0.0) + clock() - begun
            return result

        setattr(owner, name, call)

    def sized(depths, *given):
        ranges, draws, bands = sort_entries(depths, *given)
        packed = draws[: ranges[-1], sorting.ROWS]
        sizes.update(gaussians=len(depths), entries=len(packed), rows=int(((packed >> 8 & 255) - (packed & 255)).sum()))
        return ranges, draws, bands

    for part, (module, name) in PARTS.items():
        timed(importlib.import_module(module), name, part)
    timed(trainer.Adam, "step", ADAM)
    sort_entries, sorting.sort_entries = sorting.sort_entries, sized
    rounds = []
    for _ in range(args.iterations + 2):
        took.clear()
        begun = clock()
        run.step()
        took[ALL] = clock() - begun
        rounds.append(dict(took))
    source, target = np.zeros(25_000_000, np.float32), np.zeros(25_000_000, np.float32)
    copies = []
    for _ in range(5):
        begun = clock()
        np.copyto(target, source)
        copies.append(clock() - begun)
    parts = {part: [1000 * row[part] for row in rounds[2:]] for part in rounds[-1]}
    return {"parts": parts, "copy": 0.3 / statistics.median(copies), **sizes}  # GB/s: read, read before it is written


def show(args, found):
    """Print the table."""
    columns = []
    for rounds in found:
        median = {
            part: statistics.median(value for one in rounds for value in one["parts"][part])
            for part in rounds[0]["parts"]
        }
        median[REST] = median[ALL] - sum(value for part, value in median.items() if part != ALL)
        for name, parts in JOINED.items():
            median[name] = sum(median.pop(part) for part in parts)
        columns.append(median)
    last, facts = columns[-1], found[-1][-1]
    speed = statistics.median(one["copy"] for one in found[-1])
    n, entries = facts["gaussians"], facts["entries"]
    # Of a Gaussian 44 bytes beside its coefficients' 192, of a splat 72 and 35 of its footprint, of an entry 12, and 36
    # in the strip's coordinates.
    megabytes = {
        "forward: checks": n * 236 / 1e6,
        "forward: projection": n * (44 + 192 + 2 * 107) / 1e6,
        "forward: rows and sorting": (n * 200 + entries * 50) / 1e6,
        "forward: blending": entries * (12 + 72 + 2 * 36) / 1e6,
        "backward: blending": entries * (12 + 36 + 2 * 36) / 1e6,
        "backward: projection": n * (44 + 192 + 130 + 2 * 244) / 1e6,
        ADAM: n * 236 * 7 / 1e6,
    }
    print(
        f"{n:,} Gaussians, {entries:,} entries, {facts['rows']:,} rows of 8 pixels, {args.threads} thread(s), a copy: "
        f"{speed:.0f} GB/s"
    )
    heads = ["ms"] if len(columns) == 1 else ["before, ms", "after, ms"]
    print(f"| part | {' | '.join(heads)} | share | MB | as a copy, ms |")
    print(f"| --- |{' ---: |' * (len(heads) + 3)}")
    order = ["forward: checks", "forward: projection", "forward: rows and sorting", "forward: blending", "loss"]
    for part in [*order, "backward: blending", "backward: projection", ADAM, REST, ALL]:
        times = " | ".join(f"{median[part]:.1f}" for median in columns)
        size = megabytes.get(part)
        memory = "" if size is None else f"{size:.0f}"
        copy = "" if size is None else f"{size / speed:.1f}"
        print(f"| {part} | {times} | {100 * last[part] / last[ALL]:.0f}% | {memory} | {copy} |")


if __name__ == "__main__":
    main()
