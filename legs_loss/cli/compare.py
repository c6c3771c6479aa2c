"""Train several losses on a scene with several seeds, and report their differences with confidence intervals.

Each training runs in a separate process with one thread. An arm is LOSS[:CHANGE ...][@ARM]. LOSS is a preset
("legs"), a curve ("C4"), a beta ("beta=5") or settings of a spec ("curve=C5,beta=4"). CHANGE is one of: {changes}. @ARM
gives it the number of Gaussians of another arm, densification by densification ("legs@3dgs"). The baseline 3dgs is
always among the arms, and is checked to be unweighted first. Run the command again with the same --out to resume an
interrupted comparison, or to add arms and seeds. Without SCENE it makes and uses a small version of the embedded scene.
With --upstream another codebase's own script trains the arms, in a copy of its checkout, with its own density control.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Dict, Sequence

from legs_loss.cli.shared.affordable import add_scene_arguments, default_resolution
from legs_loss.system import say

if TYPE_CHECKING:
    from legs_loss.experiments.studies import Study

HELP = "train and compare several losses on a scene, with seeds, controls and intervals"

# Of the embedded scene: small enough that a laptop trains the arms of a study in some minutes.
VIEWS, WIDTH, HEIGHT = 56, 144, 108
SEEDS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.experiments.arms import CHANGES
    from legs_loss.experiments.studies import STUDIES

    changes = ", ".join(f"{name} ({what})" for name, what in CHANGES.items())
    parser.description = (__doc__ or "").format(changes=changes)
    add_scene_arguments(parser)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--arms", nargs="+", metavar="ARM", help="default: those of --study")
    what.add_argument(
        "--study",
        choices=STUDIES,
        default="main",
        help=f"a built-in list of arms, with the paper's numbers; default: main. "
        f"{'; '.join(f'{name}: {study.title}' for name, study in STUDIES.items())}",
    )
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="of each arm; default: 3")
    parser.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="of each training; default: 2000, with --upstream the codebase's own",
    )
    parser.add_argument(
        "-m", "--out", type=Path, default=Path("legs_compare"), metavar="DIR", help="default: legs_compare"
    )
    advanced = parser.add_argument_group("advanced")
    advanced.add_argument(
        "--densify_grad_threshold", type=float, metavar="X", help="of all arms; default: as for legs train"
    )
    advanced.add_argument("--tensorboard", type=Path, metavar="DIR", help="log loss, PSNR and Gaussians there")
    advanced.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a dask cluster that shares the file system; a training is a task"
    )
    upstream = parser.add_argument_group("advanced: another codebase's trainings, one at a time")
    upstream.add_argument("--upstream", type=Path, metavar="FOLDER", help="a checkout, which is copied to OUT/upstream")
    upstream.add_argument(
        "--profile", metavar="NAME|FILE", help="how it is trained: built in, or a TOML file; default: the one that fits"
    )
    upstream.add_argument("--cpu", action="store_true", help="without a GPU, by legs run --cpu: for small scenes")
    upstream.add_argument("--gaussians", type=int, metavar="N", help="for codebases that train to a fixed number")
    upstream.add_argument(
        "--extra", default="", metavar="WORDS", help="added to every training: --extra='--sh_degree 1'"
    )


def run(args: argparse.Namespace) -> int:
    """Train what is missing and print the tables."""
    from tqdm import tqdm

    from legs_loss.cli.shared.checks import check_writable
    from legs_loss.cli.train import COMPILING, set_threads
    from legs_loss.errors import LegsError
    from legs_loss.experiments.arms import needed, parse_arms
    from legs_loss.experiments.running import BASELINE, Comparison
    from legs_loss.experiments.studies import STUDIES, these_arms
    from legs_loss.reference.training.trainer import Progress, TrainConfig
    from legs_loss.report.tensorboard import tensorboard_log
    from legs_loss.scenes import read_scene

    set_threads(None)  # fail now if numba is missing
    for name in ("seeds", "processes"):
        if getattr(args, name) < 1:
            raise LegsError(f"--{name} must be at least 1, got {getattr(args, name)}")
    if args.seeds > SEEDS:
        raise LegsError(f"--seeds must be at most {SEEDS}: each is a training of every arm")
    study = STUDIES[args.study] if args.arms is None else these_arms(args.arms)
    check_writable(args.out)
    if args.upstream is not None:
        return _upstream(args, study)
    for name in ("profile", "cpu", "gaussians", "extra"):
        if getattr(args, name):
            raise LegsError(f"--{name} is for --upstream")
    arms = needed(parse_arms([BASELINE, *study.arms]))
    seeds = range(args.seeds)
    iterations = 2000 if args.iterations is None else args.iterations
    base = TrainConfig(iterations=iterations, densify_grad_threshold=args.densify_grad_threshold)
    root = _embedded(args.out / "scene") if args.scene is None else Path(args.scene)
    resolution = args.resolution
    if resolution is None:
        resolution = default_resolution(read_scene(root, args.images))
    comparison = Comparison(root, replace(base, resolution=resolution), args.out, args.images)
    proof = comparison.proof
    say(
        f"The baseline is unweighted: over {proof['views']} views its loss is {proof['loss']:.6f}, 3DGS's own "
        f"{proof['loss_3dgs']:.6f}; gradients agree to {proof['gradient_error']:.0e} of the largest."
    )
    missing = sum(comparison.row(arm, seed) is None for arm in arms for seed in seeds)
    say(f"{len(arms)} arms, {len(seeds)} seed(s); {missing} of {len(arms) * len(seeds)} trainings to do")
    reached: Dict[str, int] = {}
    bar = tqdm(total=missing * base.iterations, desc="iterations", mininterval=0.5, disable=not missing, delay=0.001)
    bar.set_postfix_str(COMPILING)
    with bar, tensorboard_log(args.tensorboard) as log:

        def show(name: str, progress: Progress) -> None:
            bar.update(progress.iteration - reached.get(name, 0))
            reached[name] = progress.iteration
            bar.set_postfix_str(f"{name}: {progress.psnr:.2f} dB, {progress.gaussians} Gaussians", refresh=False)
            log(name, progress)

        comparison.train(arms, seeds, args.processes, show, args.scheduler)
    _say_scores(args.out, study, seeds)
    return 0


def _say_scores(out: Path, study: Study, seeds: Sequence[int]) -> None:
    from legs_loss.experiments.running import read_rows
    from legs_loss.experiments.tables import study_text
    from legs_loss.reference.training.metrics import left_out

    say(study_text([row for row in read_rows(out)[1] if row["seed"] in seeds], study), lines=True)
    say(f"\n{READING}", lines=True)
    if left_out():
        say(left_out())
    say(f"Rows: {out}; as a page: legs report {out}")


def _upstream(args: argparse.Namespace, study: Study) -> int:
    from legs_loss.errors import LegsError
    from legs_loss.experiments.arms import needed, parse_arms
    from legs_loss.experiments.running import BASELINE
    from legs_loss.experiments.upstream.comparison import UpstreamComparison
    from legs_loss.experiments.upstream.profile import find_profile, split

    if args.scene is None:
        raise LegsError("--upstream needs a SCENE")
    if not args.upstream.is_dir():
        raise LegsError(f"there is no folder {args.upstream}: --upstream takes a checkout of the codebase")
    if args.scheduler is not None:
        raise LegsError("--upstream trains here, one run at a time: do not give --scheduler")
    if args.tensorboard is not None:
        raise LegsError("--upstream trains by the codebase's own script: do not give --tensorboard")
    if args.densify_grad_threshold is not None:
        raise LegsError("with --upstream give the codebase's own threshold option, by --extra")
    profile = find_profile(args.upstream, args.profile)
    comparison = UpstreamComparison(
        args.upstream,
        profile,
        Path(args.scene),
        args.out,
        images=args.images,
        resolution=args.resolution,
        iterations=args.iterations,
        gaussians=args.gaussians,
        extra=split(args.extra),
        cpu=args.cpu,
    )
    arms = needed(parse_arms([BASELINE, *study.arms]))
    seeds = range(args.seeds)
    say(f"{profile.name}: {len(arms)} arms, {len(seeds)} seed(s), one training at a time")
    comparison.train(arms, seeds, say)
    _say_scores(args.out, study, seeds)
    return 0


def _embedded(root: Path) -> Path:
    from legs_loss.errors import LegsError
    from legs_loss.reference.embedded import write_embedded_scene

    if not (root / "sparse" / "0" / "points3D.bin").is_file():  # what is written last
        say(f"making the embedded scene in {root}")
        try:
            write_embedded_scene(root, VIEWS, WIDTH, HEIGHT)
        except OSError as error:
            raise LegsError(f"cannot write {root}: {error.strerror or error}") from None
    return root


READING = """\
Means ± standard deviations over seeds. "strongest 10%" and "the rest" split each held-out photograph's pixels by their
Laplacian response, which favours the weighted losses. Differences are paired by view and seed; brackets are 95%
intervals of a hierarchical bootstrap over seeds and views; ? marks a difference whose interval holds 0, or whose seeds
differ in sign. Times are this machine's, as busy as it was."""
