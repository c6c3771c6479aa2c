"""Train 3D Gaussians on a scene, on the CPU: for small images and short runs.

SCENE is a folder with COLMAP's model (sparse/0, pinhole cameras). Every 8th view, sorted by name, is held out. Weight
maps are taken from SCENE/legs_weights where `legs precompute` left them, else computed. The flags have 3DGS's names
where they exist there. The output folder gets point_cloud/iteration_N/point_cloud.ply, which viewers of 3DGS open,
cfg.json and metrics.json.
"""

from __future__ import annotations

import argparse
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, Optional

from legs_loss.cli.shared.scene_arguments import add_images, add_resolution, read_noted
from legs_loss.system.terminal import printable, say

if TYPE_CHECKING:
    from legs_loss.lab.training.trainer import Progress, TrainConfig

HELP = "train 3D Gaussians on a scene, on the CPU"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from legs_loss.spec import PRESETS

    parser.add_argument("scene", metavar="SCENE", help="a COLMAP scene")
    add_images(parser)
    folder = "the run's folder; default: output/SCENE-PRESET"
    parser.add_argument("-m", "--out", "--model_path", dest="out", type=Path, metavar="DIR", help=folder)
    parser.add_argument("--resume", action="store_true", help="resume the run in the output folder")
    # Settings of the run. One that is not given is absent, so that --resume can tell.
    settings = parser.add_argument_group("the loss and the run", argument_default=argparse.SUPPRESS)
    settings.add_argument("--preset", dest="spec", choices=PRESETS, help="the loss; default: legs")
    settings.add_argument("--iterations", type=int, metavar="N", help="default: 2000")
    add_resolution(settings)
    settings.add_argument("-w", "--white_background", action="store_true", help="a white background, not a black one")
    settings.add_argument("--max_gaussians", type=int, metavar="N", help="a cap on their number; default: none")
    settings.add_argument("--seed", type=int, metavar="N", help="default: 0")
    advanced = parser.add_argument_group("advanced: the training", argument_default=argparse.SUPPRESS)
    advanced.add_argument("--sh_degree", type=int, choices=range(4), help="of the colours; default: 1")
    for name, kind, what in (
        ("lambda_dssim", float, "share of D-SSIM in the loss; default: 0.2"),
        ("l1_scale", float, "multiplies the L1 term; default: 1"),
        ("position_lr_max_steps", int, "iterations over which the rate of positions falls; default: all; 3DGS: 30000"),
        (
            "densify_grad_threshold",
            float,
            "default: 0.12 / sqrt(width * height), at least 3DGS's 2e-4, which is too low for small images",
        ),
    ):
        advanced.add_argument(f"--{name}", type=kind, metavar="N" if kind is int else "X", help=what)
    sparse = "a step updates only the Gaussians that its view shows, which changes the results"
    advanced.add_argument("--sparse_adam", action="store_true", help=sparse)
    places = parser.add_argument_group("advanced: files and threads")
    places.add_argument("--store", type=Path, metavar="DIR", help="weight maps; default: SCENE/legs_weights")
    places.add_argument("--tensorboard", type=Path, metavar="DIR", help="log loss, PSNR and Gaussians there")
    places.add_argument("--threads", type=int, metavar="N", help="default: one per core")
    every = "iterations between checkpoints; default: 500"
    places.add_argument("--checkpoint_every", type=int, default=500, metavar="N", help=every)


def run(args: argparse.Namespace) -> int:
    """Train, or resume a training, and print the scores."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # or torch's idle threads spin on the cores that ours need
    from legs_loss.cli.shared.checks import check_resolution, check_writable
    from legs_loss.errors import LegsError
    from legs_loss.lab.report.tensorboard import tensorboard_log
    from legs_loss.lab.training.checkpoint import CHECKPOINT, check_new
    from legs_loss.lab.training.trainer import TrainConfig, check_trainable, compile_step, point_cloud, train

    set_threads(args.threads)
    given = {name: value for name, value in vars(args).items() if name in TrainConfig.__dataclass_fields__}
    preset = given.get("spec", "legs")
    out = args.out or Path("output") / f"{Path(args.scene).resolve().name}-{preset}"
    checkpoint = out / CHECKPOINT
    if args.checkpoint_every < 1:
        raise LegsError(f"--checkpoint_every must be at least 1, got {args.checkpoint_every}")
    config = _resumed(checkpoint, given) if args.resume else TrainConfig(**given)
    scene = read_noted(args.scene, args.images)
    check_trainable(scene)
    check_resolution(config.resolution, scene.views)
    if not args.resume:
        check_new(out)  # and again when it begins: another may have begun meanwhile
    check_writable(out)
    compile_step("legs train")
    with progress_bar(config.iterations, out.name) as show, tensorboard_log(args.tensorboard) as log:

        def on_progress(progress: Progress) -> None:
            show(progress)
            log(out.name, progress)

        result = train(
            scene,
            config,
            out=out,
            resume=args.resume,
            store=args.store,
            checkpoint_every=args.checkpoint_every,
            on_progress=on_progress,
        )
    _print(result.metrics)
    say(point_cloud(out, config))
    return 0


def set_threads(count: Optional[int]) -> None:
    """Set the number of threads for drawing, the loss and torch; None keeps the defaults of numba and torch.

    Raises:
        LegsError: not between 1 and the number of cores; or numba is missing.
    """
    from legs_loss.errors import LegsError, require

    require("this command", "cpu", "numba")
    import numba
    import torch

    if count is None:
        return
    most = int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]
    if not 1 <= count <= most:
        raise LegsError(f"--threads must be between 1 and {most}, the number of cores, got {count}")
    torch.set_num_threads(count)


@contextmanager
def progress_bar(iterations: int, name: str, position: int = 0) -> Iterator[Callable[[Progress], None]]:
    """Show a bar with loss, PSNR and Gaussians; yields what ``train`` takes as ``on_progress``."""
    from tqdm import tqdm

    with tqdm(total=iterations, desc=printable(name), position=position, leave=position == 0, mininterval=0.5) as bar:

        def show(progress: Progress) -> None:
            if bar.n == 0 and progress.iteration > 10:  # resumed: this run did not compute these iterations
                bar.initial = bar.n = progress.iteration
            bar.set_postfix_str(
                f"loss {progress.loss:.4f}, PSNR {progress.psnr:.2f} dB, {progress.gaussians} Gaussians", refresh=False
            )
            bar.update(progress.iteration - bar.n)

        yield show


def _resumed(checkpoint: Path, given: Dict[str, Any]) -> TrainConfig:
    """Return the settings of the run in the output folder; the flags that were given must be the same."""
    from legs_loss.errors import LegsError
    from legs_loss.lab.training.checkpoint import read_state
    from legs_loss.lab.training.trainer import TrainConfig

    stored = read_state(checkpoint)[1]["config"]
    wanted = TrainConfig.from_dict(dict(stored, **given))
    different = [name for name in given if wanted.as_dict()[name] != stored.get(name)]
    if different:
        raise LegsError(
            f"{checkpoint.parent} holds a run with another {' and '.join(different)}: omit the flag to resume "
            "it, or choose another folder (--out)"
        )
    return wanted


def _print(metrics: Dict[str, Any]) -> None:
    from legs_loss.lab.training.metrics import METRICS

    for views, split in (("training views", "train"), ("held-out views", "test")):
        scores = metrics[split] or {}
        texts = [f"{METRICS[key].label} {value:{METRICS[key].format}}" for key, value in scores.items()]
        if texts:
            say(f"{views}: {', '.join(texts)}")
    if "masked_views" in metrics:
        say(f"masks: {metrics['masked_views']} training views masked; scores are of the pixels that count")
    say(f"{metrics['gaussians']} Gaussians, {metrics['seconds']:.0f} s")
