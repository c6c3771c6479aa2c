"""Trainings by a codebase's own script, plain and weighted, with the same seed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Sequence

from benchmarks.gpu.building import copied
from benchmarks.gpu.imports import need
from benchmarks.gpu.measured import EQUAL
from benchmarks.gpu.options import Options, Record, Skipped
from examples.reproduce_paper.codebases.profile import find_profile
from examples.reproduce_paper.codebases.training import Checkout, train_and_score
from legs_loss.lab.training.densify import Schedule
from legs_loss.spec import PRESETS

__all__ = ["fastgs", "gsplat"]

GSPLAT_BEGINS = 500  # the step after which simple_trainer.py adds Gaussians, if it is told nothing
ARMS = {"plain": PRESETS["3dgs"], "LEGS": PRESETS["legs"]}
STEPS = ("steps", "ms a step", "median ms a step", EQUAL, "peak MB", "seconds", "weighted", "plain")


def fastgs(options: Options, record: Record) -> None:
    """Train FastGS in its copy, plain and weighted; record the steps' times, PSNR, memory and number of Gaussians."""
    copy, scene = copied(options), _scene(options)
    if not options.emulate:
        need([copy / "train.py", copy / "render.py"])
    profile = find_profile(copy)
    checkout = Checkout(copy, profile, scene, None, options.resolution, options.iterations, None, (), options.emulate)
    equal = Schedule.of_run(options.iterations).densify_from
    for name, spec in ARMS.items():
        folder = Path(options.work) / profile.name / name
        folder.mkdir(parents=True, exist_ok=True)
        *_, command = commands = checkout.commands(folder.resolve() / "output", 1.0)
        report = folder / "train.json"
        if not report.is_file():
            found = _trained(options, copy, command, equal, spec.unweighted, folder)
            report.write_text(json.dumps({**found, "commands": commands}), encoding="utf-8")
        kept = json.loads(report.read_text(encoding="utf-8"))
        record(**{name: {key: kept[key] for key in STEPS if key in kept}})
        scores = train_and_score(checkout, spec, 0, folder, 1.0)  # it finds the training done, draws and scores
        record(
            **{
                name: {
                    **{key: kept[key] for key in STEPS if key in kept},
                    "PSNR train": scores["train"]["psnr"],
                    "PSNR held out": scores["test"]["psnr"] if scores["test"] else None,
                    "gaussians": scores["gaussians"],
                }
            }
        )


def gsplat(options: Options, record: Record) -> None:
    """Train gsplat's simple_trainer.py, plain and weighted; record the same, its PSNR as it prints it."""
    if options.gsplat is None:
        raise Skipped("no --gsplat CHECKOUT was given")
    scene, root = _scene(options), Path(options.gsplat)
    if not options.emulate:
        need([root / "examples" / "simple_trainer.py"])
    record(weights=weighted_lines(root, "examples/simple_trainer.py"))
    if options.emulate:
        raise Skipped("needs CUDA: gsplat's rasterizer has no shim")
    for name, spec in ARMS.items():
        folder = Path(options.work) / "gsplat" / name
        folder.mkdir(parents=True, exist_ok=True)
        number = str(options.iterations)
        command = ["simple_trainer.py", "default", "--data_dir", str(scene), "--data_factor", "1"]
        command += ["--result_dir", str(folder / "output"), "--max_steps", number, "--eval_steps", number]
        command += ["--save_steps", number, "--disable_viewer"]
        found = _trained(options, root / "examples", command, GSPLAT_BEGINS, spec.unweighted, folder)
        scores: Dict[str, Any] = {}
        for path in sorted((folder / "output" / "stats").glob("val_step*.json")):
            scores = json.loads(path.read_text(encoding="utf-8"))
        record(
            **{
                name: {
                    **{key: found[key] for key in STEPS if key in found},
                    "PSNR held out": scores.get("psnr"),
                    "gaussians": scores.get("num_GS"),
                }
            }
        )


def weighted_lines(root: Path, file: str) -> List[str]:
    """Return the calls of a checkout's file that `legs run` would weight."""
    command = [sys.executable, "-m", "legs_adapters.cli", "--diff", "--json", str(root)]
    done = subprocess.run(command, capture_output=True, text=True)
    sites = json.loads(done.stdout)["sites"]
    return [f"line {site['line']}: {site['code']}" for site in sites if site["file"] == file]


def _scene(options: Options) -> Path:
    if options.scene is None:
        raise Skipped("no --scene FOLDER was given")
    return Path(options.scene)


def _trained(
    options: Options, root: Path, command: Sequence[str], equal: int, plain: bool, folder: Path
) -> Dict[str, Any]:
    """Run a training script and return its report; ``equal``: before which step no Gaussian is added."""
    report, log = folder / "train.part", folder / "train.log"
    words: List[str] = [sys.executable, "-m", "benchmarks.gpu.measured", str(report), str(equal)]
    words += ["--emulate", "--cpu"] if options.emulate else []
    environment = dict(os.environ, LEGS_OFF="1" if plain else "0", PYTHONHASHSEED="0")
    with open(str(log), "wb") as said:
        code = subprocess.run(
            [*words, *command], cwd=str(root), env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=said
        ).returncode
    if code != 0:
        lines = log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n").strip().splitlines()
        print("\n".join(lines[-20:]), flush=True)
        raise RuntimeError(f"{command[0]} ended with exit code {code}: {(lines or ['no message'])[-1]}")
    return json.loads(report.read_text(encoding="utf-8"))
