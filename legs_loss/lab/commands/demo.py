"""Compute weight maps, train 3dgs, eggs, legs-l and legs side by side on the CPU, and save a table and pictures.

Without SCENE it makes and uses the embedded scene. Trainings run in processes with one thread each. The table
has the number of Gaussians beside PSNR, since more Gaussians are part of the gain.
"""

from __future__ import annotations

import argparse
import os
import shlex
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List

from legs_loss.cli.shared.scene_arguments import read_noted
from legs_loss.lab.commands.arguments import add_scene_arguments, default_resolution
from legs_loss.system.terminal import progress, say

HELP = "train four losses on the embedded scene or your own: weight maps, a table and pictures"

METHODS = ("3dgs", "eggs", "legs-l", "legs")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_scene_arguments(parser)
    parser.add_argument(
        "-m",
        "--out",
        type=Path,
        default=Path("legs_demo"),
        metavar="DIR",
        help="for all results, which replace those of an earlier demo there; default: legs_demo",
    )
    parser.add_argument("--iterations", type=int, default=1000, metavar="N", help="of each training; default: 1000")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")


def run(args: argparse.Namespace) -> int:
    """Make or read the scene, precompute, train, print the table and save the pictures."""
    from legs_loss.cli.shared.checks import check_writable
    from legs_loss.errors import LegsError, require
    from legs_loss.lab.commands.train import progress_bar
    from legs_loss.lab.embedded import write_embedded_scene
    from legs_loss.lab.training.checkpoint import CHECKPOINT, write_json
    from legs_loss.lab.training.side_by_side import Arm, train_side_by_side
    from legs_loss.lab.training.trainer import TrainConfig, check_trainable, compile_step
    from legs_loss.precompute import precompute
    from legs_loss.spec import PRESETS

    started = time.perf_counter()
    require("legs demo", "report", "numba", "matplotlib")
    if args.processes < 1:
        raise LegsError(f"--processes must be at least 1, got {args.processes}")
    out: Path = args.out
    check_writable(out)
    root = out / "scene" if args.scene is None else Path(args.scene)
    if args.scene is None:
        say(f"making the embedded scene in {root}")
        write_embedded_scene(root)
    scene = read_noted(root, args.images)
    check_trainable(scene)
    resolution = args.resolution if args.resolution is not None else default_resolution(scene)

    store = out / "legs_weights"  # not in the scene folder, which is the user's
    for spec in {PRESETS[name].operator: PRESETS[name] for name in METHODS}.values():
        with progress(len(scene.views), "weight maps") as bar:
            report = precompute(scene, store, spec, resolution, on_progress=lambda done, of: bar.update(done - bar.n))
        for view, reason in report.skipped.items():
            raise LegsError(f"{view}: {reason}")

    compile_step("legs demo")  # once, before the processes that train load it
    base = TrainConfig(iterations=args.iterations, resolution=resolution, seed=args.seed)
    arms = [Arm(name, root, replace(base, spec=name), out / name, args.images, store) for name in METHODS]
    for arm in arms:  # of an earlier demo, which this one replaces
        with suppress(FileNotFoundError):
            (out / arm.name / CHECKPOINT).unlink()
    with ExitStack() as stack:
        bars = {
            arm.name: stack.enter_context(progress_bar(args.iterations, f"{arm.name:>6}", position))
            for position, arm in enumerate(arms)
        }
        # The one with the most Gaussians takes longest, so it starts first.
        metrics = train_side_by_side(arms[::-1], args.processes, lambda name, progress: bars[name](progress))
    metrics = {arm.name: metrics[arm.name] for arm in arms}
    view, sheet = _save_pictures(scene, arms, metrics, out / "pictures")
    write_json(out / "results.json", metrics)
    say(table(metrics), lines=True)
    say(conclusion(metrics))
    say(
        f"Pictures of the held-out view {view}: {sheet.parent}{os.sep}METHOD-rendering.png, -error.png, -weight.png; "
        f"on one sheet: {sheet}"
    )
    say(f"Scenes: {out}{os.sep}METHOD{os.sep}point_cloud{os.sep}...{os.sep}point_cloud.ply")
    moved = "" if args.scene is None else f" -s {shlex.quote(args.scene)}"
    say(f"Look at them in the browser: legs view {shlex.quote(str(out))}{moved} (it needs viser: pip install viser)")
    say(f"{time.perf_counter() - started:.0f} s in all")
    return 0


def table(metrics: Dict[str, Dict[str, Any]]) -> str:
    """Return the results as text, a line for each method."""
    from legs_loss.lab.experiments.statistics import summarise
    from legs_loss.lab.experiments.tables import LABELS, markdown, score_cells, with_values

    lines = []
    for name, values in metrics.items():
        summary = summarise([{"arm": name, "metrics": values}])
        lines.append([name, *score_cells(summary), f"{values['seconds']:.0f} s"])
    return markdown(*with_values(["method", *LABELS, "time"], lines))


def conclusion(metrics: Dict[str, Dict[str, Any]]) -> str:
    """Return the note on how to read the table."""
    plain, legs = metrics["3dgs"], metrics["legs"]
    return (
        f"legs has {legs['gaussians'] / plain['gaussians']:.1f} times as many Gaussians as 3dgs: a larger L1 term "
        "makes larger gradients, and 3DGS's threshold for densifying is absolute. More Gaussians are part of the gain; "
        "`legs train --max_gaussians` compares at equal numbers. Seeds differ by up to 0.2 dB."
    )


def _save_pictures(scene: Any, arms: List[Any], metrics: Dict[str, Dict[str, Any]], folder: Path) -> Any:
    from legs_loss.lab.ply import read_ply
    from legs_loss.lab.report.comparison import Compared, save_pictures
    from legs_loss.lab.training.dataset import load_view, split_views
    from legs_loss.lab.training.trainer import draw, point_cloud
    from legs_loss.weights import weight_map

    held_out = split_views(scene)[1]
    chosen = held_out[len(held_out) // 2]
    view = load_view(scene, chosen, arms[0].config.resolution)
    compared = [
        Compared(
            arm.name,
            draw(read_ply(point_cloud(arm.out, arm.config)), view, arm.config),
            weight_map(view.image, arm.config.spec),
            f"held out: {metrics[arm.name]['test']['psnr']:.2f} dB, {metrics[arm.name]['gaussians']} Gaussians",
        )
        for arm in arms
    ]
    sheet = save_pictures(folder, f"{scene.root.resolve().name}: {chosen.name}, held out", view.image, compared)
    return chosen.name, sheet
