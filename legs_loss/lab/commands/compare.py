"""Train several losses on a scene with several seeds, and report their differences with confidence intervals.

Trainings run in processes with one thread each. An arm is LOSS[:CHANGE ...][@ARM]. LOSS is a preset
("legs"), a curve ("C4"), a beta ("beta=5") or settings of a spec ("curve=C5,beta=4"). CHANGE is one of: {changes}. @ARM
gives it the number of Gaussians of another arm, densification by densification ("legs@3dgs"). The baseline 3dgs is
always among the arms, and is checked to be unweighted first. Run the command again with the same --out to resume an
interrupted comparison, or to add arms and seeds. Without SCENE it makes and uses a small version of the embedded scene.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Dict, Sequence

from legs_loss.cli.shared.scene_arguments import read_noted
from legs_loss.lab.commands.arguments import add_scene_arguments, default_resolution
from legs_loss.system.terminal import say

HELP = "train and compare several losses on a scene, with seeds, controls and intervals"

# Of the embedded scene: small enough that a laptop trains the arms of a study in some minutes.
VIEWS, WIDTH, HEIGHT = 56, 144, 108
SEEDS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.lab.experiments.arms import CHANGES, STUDIES

    changes = ", ".join(f"{name} ({what})" for name, what in CHANGES.items())
    parser.description = (__doc__ or "").format(changes=changes)
    add_scene_arguments(parser)
    studies = (f"{name}: {' '.join(arms)}" for name, arms in STUDIES.items())
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--arms", nargs="+", metavar="ARM", help="default: those of --study")
    what.add_argument(
        "--study", choices=STUDIES, default="main", help=f"a built-in list of arms; default: main. {'; '.join(studies)}"
    )
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="of each arm; default: 3")
    parser.add_argument("--iterations", type=int, default=2000, metavar="N", help="of each training; default: 2000")
    parser.add_argument(
        "-m", "--out", type=Path, default=Path("legs_compare"), metavar="DIR", help="default: legs_compare"
    )
    advanced = parser.add_argument_group("advanced")
    advanced.add_argument(
        "--lpips",
        type=Path,
        metavar="WEIGHTS",
        help="score LPIPS, too, by this state dict of torchvision's squeezenet1_1, alexnet or vgg16",
    )
    advanced.add_argument(
        "--densify_grad_threshold", type=float, metavar="X", help="of all arms; default: as for legs train"
    )
    advanced.add_argument("--tensorboard", type=Path, metavar="DIR", help="log loss, PSNR and Gaussians there")
    advanced.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a dask cluster that shares the file system; a training is a task"
    )


def run(args: argparse.Namespace) -> int:
    """Train what is missing and print the tables."""
    from tqdm import tqdm

    from legs_loss.cli.shared.checks import check_writable
    from legs_loss.errors import LegsError
    from legs_loss.lab.commands.train import set_threads
    from legs_loss.lab.experiments.arms import STUDIES, needed, parse_arms, these_arms
    from legs_loss.lab.experiments.running import Comparison
    from legs_loss.lab.report.tensorboard import tensorboard_log
    from legs_loss.lab.training.trainer import Progress, TrainConfig, compile_step

    set_threads(None)  # fail now if numba is missing
    if args.processes < 1:
        raise LegsError(f"--processes must be at least 1, got {args.processes}")
    seeds = seeds_of(args)
    names = these_arms(STUDIES[args.study] if args.arms is None else args.arms)
    check_writable(args.out)
    arms = needed(parse_arms(names))
    base = TrainConfig(iterations=args.iterations, densify_grad_threshold=args.densify_grad_threshold)
    root = _embedded(args.out / "scene") if args.scene is None else Path(args.scene)
    scene = read_noted(root, args.images)
    resolution = default_resolution(scene) if args.resolution is None else args.resolution
    comparison = Comparison(root, replace(base, resolution=resolution), args.out, args.images, args.lpips)
    proof = comparison.proof
    say(
        f"The baseline is unweighted: over {proof['views']} views its loss is {proof['loss']:.6f}, 3DGS's own "
        f"{proof['loss_3dgs']:.6f}; gradients agree to {proof['gradient_error']:.0e} of the largest."
    )
    missing = sum(comparison.row(arm, seed) is None for arm in arms for seed in seeds)
    say(f"{len(arms)} arms, {len(seeds)} seed(s); {missing} of {len(arms) * len(seeds)} trainings to do")
    if missing and args.scheduler is None:
        compile_step("legs compare")
    reached: Dict[str, int] = {}
    bar = tqdm(total=missing * base.iterations, desc="iterations", mininterval=0.5, disable=not missing, delay=0.001)
    with bar, tensorboard_log(args.tensorboard) as log:

        def show(name: str, progress: Progress) -> None:
            bar.update(progress.iteration - reached.get(name, 0))
            reached[name] = progress.iteration
            bar.set_postfix_str(f"{name}: {progress.psnr:.2f} dB, {progress.gaussians} Gaussians", refresh=False)
            log(name, progress)

        comparison.train(arms, seeds, args.processes, show, args.scheduler)
    say_scores(args.out, names, seeds)
    return 0


def seeds_of(args: argparse.Namespace) -> Sequence[int]:
    """Return the seeds that --seeds says.

    Raises:
        LegsError: none, or more than anyone trains.
    """
    from legs_loss.errors import LegsError

    if not 1 <= args.seeds <= SEEDS:
        bound = "at least 1" if args.seeds < 1 else f"at most {SEEDS}: each is a training of every arm"
        raise LegsError(f"--seeds must be {bound}, got {args.seeds}")
    return range(args.seeds)


def say_scores(out: Path, arms: Sequence[str], seeds: Sequence[int]) -> None:
    """Print the tables of a comparison's rows, and how to read them."""
    from legs_loss.lab.experiments.running import read_rows
    from legs_loss.lab.experiments.tables import tables
    from legs_loss.lab.training.metrics import left_out

    say(tables([row for row in read_rows(out)[1] if row["seed"] in seeds], arms), lines=True)
    say(f"\n{READING}", lines=True)
    if left_out():
        say(left_out())
    say(f"Rows: {out}; as a page: legs report {out}")


def _embedded(root: Path) -> Path:
    from legs_loss.lab.embedded import write_embedded_scene

    if not (root / "sparse" / "0" / "points3D.bin").is_file():  # what is written last
        say(f"making the embedded scene in {root}")
        write_embedded_scene(root, VIEWS, WIDTH, HEIGHT)
    return root


READING = """\
Means ± standard deviations over seeds. "strongest 10%" and "the rest" split each held-out photograph's pixels by their
Laplacian response, which favours the weighted losses. Differences are paired by view and seed; brackets are 95%
intervals of a hierarchical bootstrap over seeds and views; ? marks a difference whose interval holds 0, or whose seeds
differ in sign. Times are this machine's, as busy as it was."""
