"""Compare losses in trainings by another codebase's own script, with its own density control.

    python examples/reproduce_paper/compare.py SCENE CHECKOUT --arms legs 3dgs@legs --seeds 2

Arms, seeds, rows and tables are those of `legs compare`, and `legs report` makes the page of the folder. The trainings
run one at a time in a copy of the checkout, OUT/upstream. Given again with the same --out it goes on, or adds arms and
seeds. Arms may have the change mean1; @ARM lowers or raises the codebase's thresholds until the numbers of Gaussians
agree within 1%.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Optional, Sequence

# The four losses, LEGS's maps of mean 1, and the unweighted codebase at LEGS's number of Gaussians.
ARMS = ("eggs", "legs-l", "legs", "legs:mean1", "3dgs@legs")


def parser() -> argparse.ArgumentParser:
    """Return the command's arguments."""
    summary, _, rest = (__doc__ or "").partition("\n\n")
    made = argparse.ArgumentParser(description=summary, epilog=rest, formatter_class=argparse.RawTextHelpFormatter)
    made.add_argument("scene", type=Path, metavar="SCENE", help="a COLMAP scene")
    made.add_argument("checkout", type=Path, metavar="CHECKOUT", help="of the codebase; nothing is written there")
    made.add_argument("--arms", nargs="+", metavar="ARM", default=ARMS, help=f"default: {' '.join(ARMS)}")
    made.add_argument("--seeds", type=int, default=3, metavar="N", help="of each arm; default: 3")
    made.add_argument("-m", "--out", type=Path, default=Path("legs_compare"), metavar="DIR")
    made.add_argument(
        "--profile", metavar="NAME|FILE", help="how it is trained: built in, or a TOML file; default: the one that fits"
    )
    made.add_argument("--images", metavar="DIR", help="folder of the photographs, in the scene or a path")
    made.add_argument("-r", "--resolution", type=int, metavar="1|2|4|8|WIDTH", help="default: the codebase's own")
    made.add_argument("--iterations", type=int, metavar="N", help="default: the codebase's own")
    made.add_argument("--cpu", action="store_true", help="without a GPU, by legs run --cpu: for small scenes")
    made.add_argument("--gaussians", type=int, metavar="N", help="for codebases that train to a fixed number")
    made.add_argument("--extra", default="", metavar="WORDS", help="added to every training: --extra='--sh_degree 1'")
    return made


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Train what is missing and print the tables; 2 for bad input."""
    from legs_loss.cli import say_error
    from legs_loss.errors import LegsError

    try:
        return run(parser().parse_args(argv))
    except LegsError as error:
        say_error("compare", error)
        return 2


def run(args: argparse.Namespace) -> int:
    """Train what is missing and print the tables."""
    from examples.reproduce_paper.codebases.comparison import UpstreamComparison
    from examples.reproduce_paper.codebases.profile import find_profile, split
    from legs_loss.cli.shared.checks import check_writable
    from legs_loss.errors import LegsError
    from legs_loss.lab.commands.compare import say_scores, seeds_of
    from legs_loss.lab.experiments.arms import needed, parse_arms, these_arms
    from legs_loss.system.terminal import say

    seeds = seeds_of(args)
    names = these_arms(args.arms)
    check_writable(args.out)
    if not args.checkout.is_dir():
        raise LegsError(f"there is no folder {args.checkout}: give a checkout of the codebase")
    profile = find_profile(args.checkout, args.profile)
    comparison = UpstreamComparison(
        args.checkout,
        profile,
        args.scene,
        args.out,
        images=args.images,
        resolution=args.resolution,
        iterations=args.iterations,
        gaussians=args.gaussians,
        extra=split(args.extra),
        cpu=args.cpu,
    )
    arms = needed(parse_arms(names))
    say(f"{profile.name}: {len(arms)} arms, {len(seeds)} seed(s), one training at a time")
    comparison.train(arms, seeds, say)
    say_scores(args.out, names, seeds)
    return 0


if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])  # the repository, in place of this folder
    sys.exit(main())
