"""Train arms by 3DGS's own schedule of 30,000 iterations on the CPU, and score them at milestones.

    python schedule.py SCENE OUT --arms 3dgs legs 3dgs@legs --until 7000

Each arm is trained to a milestone before any goes on to the next. Given again, it goes on where it stopped. As 3DGS, it
scores before the densification that a milestone ends with. OUT/ARM/metrics-N.json has the scores; docs/evidence.md
the table of what was trained so far.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from legs_loss.lab.experiments.arms import ArmSpec, needed, parse_arm, parse_arms
from legs_loss.lab.training import TrainConfig, train
from legs_loss.lab.training.perceptual import use_lpips
from legs_loss.scenes import read_scene

THRESHOLD = 2e-4  # 3DGS's own, at any size
MILESTONES = (*range(500, 4000, 500), *range(4000, 8000, 1000), 10000, 15000, 20000, 25000, 30000)


def main() -> None:
    """Train what is missing."""
    args = arguments(str(__doc__))
    torch.set_num_threads(1)  # one thread an arm: several scripts, each with arms of its own, use more cores
    for milestone in (at for at in args.milestones if at <= args.until):
        for arm in needed(parse_arms(args.arms)):
            path = args.out / arm.folder / f"metrics-{milestone}.json"
            if not path.is_file():
                metrics = reach(arm, milestone, args)
                path.write_text(json.dumps(metrics), encoding="utf-8")
                print(milestone, arm.name, metrics["train"], metrics["test"], metrics["gaussians"], flush=True)


def arguments(description: str) -> argparse.Namespace:
    """Return the command's arguments."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=["3dgs", "legs", "3dgs@legs"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--until", type=int, default=7000, metavar="N")
    parser.add_argument("--milestones", type=int, nargs="+", default=MILESTONES, metavar="N")
    parser.add_argument("--lpips", type=Path, metavar="WEIGHTS", help="as of legs compare")
    parser.add_argument("-r", "--resolution", type=int, default=800)
    parser.add_argument("--iterations", type=int, default=30000, help="of the schedule")
    args = parser.parse_args()
    use_lpips(args.lpips)
    return args


def settings(arm: ArmSpec, args: argparse.Namespace) -> TrainConfig:
    """Return the settings of an arm by 3DGS's schedule."""
    base = TrainConfig(
        iterations=args.iterations,
        resolution=args.resolution,
        sh_degree=3,
        position_lr_max_steps=args.iterations,
        seed=args.seed,
    )
    return arm.config(base, THRESHOLD, mean_weight=1.0)


def reach(arm: ArmSpec, milestone: int, args: argparse.Namespace) -> dict:
    """Train an arm on to a milestone, and return its scores there."""
    caps = None
    if arm.at is not None:
        leader = args.out / parse_arm(arm.at).folder / f"metrics-{milestone}.json"
        caps = dict(json.loads(leader.read_text(encoding="utf-8"))["growth"])
    stop = milestone if milestone == args.iterations else milestone - 1
    folder = args.out / arm.folder
    folder.mkdir(parents=True, exist_ok=True)
    return train(read_scene(args.scene), settings(arm, args), folder, resume=None, stop=stop, caps=caps).metrics


if __name__ == "__main__":
    main()
