"""The LEGS paper's main table, measured: 3DGS, FastGS and FasterGS with and without the loss, on its two datasets.

    python reproduce.py --inria gaussian-splatting --fastgs FastGS --nerficg nerficg --data datasets --dry-run

DATA holds tanksandtemples/{truck,train} and mipnerf360/{bicycle,...}. Each codebase is run with its own official
commands and split, unpatched and (in memory, by `legs run`) with each preset. The paper scores training views: this
scores them and those held out. For each preset there is the count control: the unpatched codebase with its
densification threshold lowered until it has as many Gaussians. Every finished step is remembered in OUT, so that the
same command goes on after an interruption. --dry-run prints every command and runs none.

The codebases fix their random seeds themselves (0), so a table is one seed; how far seeds scatter is said in
docs/evidence.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence

from codebases import CODEBASES, DATASETS, Codebase, Command, Place
from scoring import gaussians, score

PRESETS = ("eggs", "legs-l", "legs")
CLOSE = 0.01  # of the number of Gaussians: what the count control meets
TRIALS = 6

# What of the paper's results is known here, for the tables' foot.
PAPER = (
    "The paper reports LEGS 1.2 to 1.7 dB above the codebase it is added to, on training views, and by curve on "
    "Tanks & Temples: C3 28.20, C5 28.06, C1 27.95, C4 27.76, C2 27.72. It has no held-out views and no count control."
)


def main() -> int:
    """Plan or run, and print the tables of what is there."""
    args = arguments()
    run = Run(args.out, args.dry_run)
    for codebase in codebases(args):
        for place in places(args):
            run.scene(codebase, place, args.presets, args.count_control)
    if not args.dry_run:
        text = tables(run.rows)
        (args.out / "tables.md").write_text(text + "\n", encoding="utf-8")
        print(text)
    return 0


def arguments() -> argparse.Namespace:
    """Read the command line."""
    summary, _, rest = __doc__.partition("\n\n")
    parser = argparse.ArgumentParser(description=summary, epilog=rest, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--inria", type=Path, metavar="DIR", help="a checkout of graphdeco-inria/gaussian-splatting")
    parser.add_argument("--fastgs", type=Path, metavar="DIR", help="a checkout of fastgs/FastGS")
    parser.add_argument("--nerficg", type=Path, metavar="DIR", help="a checkout of NeRFICG with FasterGS in it")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--data", type=Path, metavar="DIR", help="the folder of tanksandtemples/ and mipnerf360/")
    where.add_argument("--own", type=Path, metavar="SCENE", help="one COLMAP scene of yours in their place")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="of the datasets; default: all")
    parser.add_argument("--presets", nargs="+", choices=PRESETS, default=list(PRESETS), help="default: all three")
    parser.add_argument("--no-count-control", dest="count_control", action="store_false", help="without its trainings")
    parser.add_argument("--out", type=Path, default=Path("reproduced"), metavar="DIR", help="default: reproduced")
    parser.add_argument("--cpu", action="store_true", help="without a GPU, by `legs run --cpu`: for small scenes")
    parser.add_argument(
        "--extra", default="", metavar="WORDS", help="added to every training: --extra='--iterations 100'"
    )
    parser.add_argument("--dry-run", action="store_true", help="print every command, run none")
    args = parser.parse_args()
    if not (args.inria or args.fastgs or args.nerficg):
        parser.error("name at least one checkout: --inria, --fastgs, --nerficg")
    for folder in (args.inria, args.fastgs, args.nerficg, args.data, args.own):
        if folder is not None and not folder.is_dir():
            parser.error(f"{folder} is not a folder")
    unknown = set(args.scenes or ()) - {name for names in DATASETS.values() for name in names}
    if unknown:
        parser.error(f"unknown scene {', '.join(sorted(unknown))}")
    args.out = args.out.resolve()
    return args


def codebases(args: argparse.Namespace) -> List[Codebase]:
    """The checkouts that were named."""
    roots = {"3dgs": args.inria, "fastgs": args.fastgs, "fastergs": args.nerficg}
    extra = shlex.split(args.extra)
    found = [CODEBASES[name](root.resolve(), args.cpu, extra) for name, root in roots.items() if root is not None]
    for codebase in found:
        patched = codebase.patched()
        if patched is not None:  # its unpatched trainings would not be
            sys.exit(f"reproduce: error: {patched} is patched already: legs-patch --undo {codebase.root}")
    return found


def places(args: argparse.Namespace) -> List[Place]:
    """The scenes."""
    if args.own is not None:
        return [Place(args.own.resolve(), "own", args.own.resolve().name)]
    found = [
        Place((args.data / dataset / name).resolve(), dataset, name)
        for dataset, names in DATASETS.items()
        for name in names
        if args.scenes is None or name in args.scenes
    ]
    missing = [place for place in found if not place.path.is_dir()]
    if missing and not args.dry_run:
        sys.exit(f"reproduce: error: there is no {missing[0].path}: name those that you have with --scenes")
    return found


class Run:
    """All trainings in one folder, each done once."""

    def __init__(self, out: Path, dry: bool) -> None:
        self.out, self.dry = out, dry
        self.rows: List[Dict[str, Any]] = []

    def scene(self, codebase: Codebase, place: Place, presets: Sequence[str], count_control: bool) -> None:
        """One scene with one codebase: unpatched, with each preset, and each one's count control."""
        base = self.arm(codebase, place, "plain", None, 1.0)
        for preset in presets:
            patched = self.arm(codebase, place, preset, preset, 1.0)
            if count_control:
                self.count_control(codebase, place, preset, base, patched)

    def count_control(
        self, codebase: Codebase, place: Place, preset: str, base: Dict[str, Any], patched: Dict[str, Any]
    ) -> None:
        """Train unpatched with other thresholds until it has as many Gaussians as ``patched``; keep the closest."""
        if self.dry:
            print(f"# as many Gaussians as {preset}: up to {TRIALS} trainings, each threshold found from those before")
            self.arm(codebase, place, f"plain-at-{preset}-1", None, 0.5)
            return
        target = patched["gaussians"]
        tried = [(1.0, base["gaussians"], base)]
        factor = 0.5 if target > base["gaussians"] else 2.0
        for trial in range(1, TRIALS + 1):
            if min(abs(count / target - 1) for _, count, _ in tried) <= CLOSE:
                break
            row = self.arm(codebase, place, f"plain-at-{preset}-{trial}", None, factor, keep=False)
            tried.append((factor, row["gaussians"], row))
            factor = next_factor([(one, count) for one, count, _ in tried], target)
        _, _, best = min(tried, key=lambda one: abs(one[1] / target - 1))
        self.rows.append(dict(best, arm=f"plain at {preset}'s number"))

    def arm(
        self, codebase: Codebase, place: Place, arm: str, preset: Optional[str], factor: float, keep: bool = True
    ) -> Dict[str, Any]:
        """Train, render and score one arm, each step unless it is done; return its row."""
        folder = self.out / codebase.name / place.name / arm
        print(f"# {codebase.name}, {place.name}, {arm}", flush=True)
        self.step(folder, "train", codebase.train(place, folder, preset, factor))
        # Only now is it known where FasterGS put its run.
        self.step(folder, "render", codebase.render(place, folder))
        if self.dry:
            return {}
        path = folder / "row.json"
        if not path.is_file():
            row = {
                "codebase": codebase.name,
                "scene": place.name,
                "dataset": place.dataset,
                "arm": arm,
                "factor": factor,
            }
            results = codebase.results(folder)
            row["gaussians"] = gaussians(_only(results, codebase.cloud))
            for split in ("train", "test"):
                renders, truths = codebase.render_folders[split], codebase.truth_folders[split]
                row[split] = score(_only(results, renders), _only(results, truths))
            _write(path, row)
        row = json.loads(path.read_text(encoding="utf-8"))
        if keep:
            self.rows.append(row)
        return row

    def step(self, folder: Path, name: str, commands: Sequence[Command]) -> None:
        """Run commands unless they are done; the file that remembers it holds them."""
        done = folder / f"{name}.done"
        if self.dry:
            for command in commands:
                print(command)
            return
        words = "\n".join(map(str, commands)) + "\n"
        if done.is_file():
            if name == "train" and done.read_text(encoding="utf-8") != words:
                sys.exit(f"reproduce: error: {done}: it was done by other commands: choose another folder (--out)")
            return
        folder.mkdir(parents=True, exist_ok=True)
        for command in commands:
            print(command, flush=True)
            with open(str(folder / f"{name}.log"), "ab") as log:
                environment = dict(os.environ, **command.environment)
                ended = subprocess.run(command.words, cwd=str(command.folder), env=environment, stdout=log, stderr=log)
            if ended.returncode != 0:
                sys.exit(f"reproduce: error: it ended with {ended.returncode}; see {folder / f'{name}.log'}")
        part = done.with_name(done.name + ".part")
        part.write_text(words, encoding="utf-8")
        os.replace(str(part), str(done))


def next_factor(tried: Sequence[Any], target: int) -> float:
    """The next threshold's factor, by a line through the two closest numbers in logarithms.

    >>> round(next_factor([(1.0, 100), (0.5, 200)], 400), 3)  # the number goes with 1 / factor
    0.25
    """
    (first, first_count), (second, second_count) = sorted(tried, key=lambda one: abs(math.log(one[1] / target)))[:2]
    if first_count == second_count or first == second:
        return first * (0.7 if first_count < target else 1.4)
    slope = math.log(first / second) / math.log(first_count / second_count)
    factor = first * math.exp(slope * math.log(target / first_count))
    return min(10.0 * first, max(0.1 * first, factor))


def tables(rows: Sequence[Dict[str, Any]]) -> str:
    """A table a codebase: every scene and arm, and what the paper says below."""
    parts = []
    for codebase in dict.fromkeys(row["codebase"] for row in rows):
        own = [row for row in rows if row["codebase"] == codebase]
        lines = [
            f"## {codebase}",
            "",
            "| scene | arm | train PSNR | SSIM | LPIPS | held-out PSNR | SSIM | LPIPS | Gaussians |",
            "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
        ]
        for row in own:
            scores = [_cell(row[split][key], key) for split in ("train", "test") for key in ("psnr", "ssim", "lpips")]
            lines.append(f"| {row['scene']} | {row['arm']} | {' | '.join(scores)} | {row['gaussians']:,} |")
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, PAPER])


def _cell(value: Optional[float], key: str) -> str:
    return "–" if value is None else f"{value:.2f}" if key == "psnr" else f"{value:.4f}"


def _only(folder: Path, pattern: str) -> Path:
    found = sorted(folder.glob(pattern))
    if not found:
        sys.exit(f"reproduce: error: there is no {folder / pattern}")
    return found[-1]


def _write(path: Path, values: Dict[str, Any]) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    os.replace(str(part), str(path))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("reproduce: interrupted: the same command goes on", file=sys.stderr)
        sys.exit(130)
