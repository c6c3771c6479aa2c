"""Plan every checkout of a folder with legs-patch, and compare with the plans of an earlier run.

    python -m benchmarks.corpus CHECKOUTS plans.json --save     # before a change: plan, and save
    python -m benchmarks.corpus CHECKOUTS plans.json            # after it: plan, and print what differs
    python -m benchmarks.corpus CHECKOUTS plans.json --sites    # only what is edited counts, no word of a report
    python -m benchmarks.corpus CHECKOUTS plans.json --ablate   # each part switched off: what it decides, where
    python -m benchmarks.corpus CHECKOUTS masks.json --masks    # plan with legs-patch --masks, save, and print counts

A plan is the report of `legs-patch --check --json`: call sites, what was left and why, problems.
Nothing is written to a checkout. Each is planned in a process of its own, which is killed at the limit.
--ablate compares with plans.json, too, as the plans that were judged; it needs os.fork.
Exit codes: 0 nothing differs, saved, a table or counts; 1 a plan differs; 2 bad usage.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

from tqdm import tqdm

from benchmarks import ablation

Plan = Dict[str, Any]
CONTEXT = multiprocessing.get_context("forkserver" if hasattr(os, "fork") else "spawn")
LOADED = ["legs_adapters.cli", "benchmarks.ablation"]  # once, in the process that the others are forked from


def main(argv: Optional[Sequence[str]] = None) -> int:
    args = parse(argv)
    folders = sorted(path for path in args.checkouts.iterdir() if path.is_dir())
    started = time.perf_counter()
    work = _ablated if args.ablate else _masked if args.masks else _planned
    plans, seconds = answers(work, folders, args.jobs, args.limit)
    slowest = sorted(seconds, key=lambda name: -seconds[name])[:3]
    print(
        f"{len(plans)} plans in {time.perf_counter() - started:.0f} s; slowest: "
        + ", ".join(f"{name} {seconds[name]:.1f} s" for name in slowest),
        file=sys.stderr,
    )
    if args.ablate:
        print(ablation.table(args.before, plans))
        return 0
    if args.save or args.masks:
        args.plans.write_text(json.dumps(plans, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        if args.masks:
            print(masks_in(plans))
        return 0
    different = compare(args.before, plans, args.sites)
    print(f"{len(args.before)} before, {len(plans)} after, {different} differ")
    return 1 if different else 0


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.corpus", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkouts", type=Path, metavar="CHECKOUTS", help="a folder; every folder in it is a checkout")
    parser.add_argument("plans", type=Path, metavar="PLANS", help="the file of plans")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--save", action="store_true", help="write PLANS instead of comparing with it")
    what.add_argument("--sites", action="store_true", help="compare call sites and the lines of problems only")
    what.add_argument("--ablate", action="store_true", help="print what each part of the patcher decides")
    what.add_argument("--masks", action="store_true", help="plan with --masks, write PLANS, and print what is masked")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="default: %(default)s")
    parser.add_argument("--limit", type=float, default=300, metavar="SECONDS", help="a checkout; default: %(default)s")
    args = parser.parse_args(argv)
    if not args.checkouts.is_dir() or not any(path.is_dir() for path in args.checkouts.iterdir()):
        parser.error(f"{args.checkouts}: no folder with checkouts in it")
    if args.jobs < 1 or not args.limit > 0:
        parser.error("--jobs and --limit must be greater than 0")
    if args.ablate and not hasattr(os, "fork"):
        parser.error("--ablate needs os.fork, which this system lacks")
    if not (args.save or args.masks):
        args.before = read_plans(parser, args.plans)
    return args


def read_plans(parser: argparse.ArgumentParser, path: Path) -> Dict[str, Plan]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        parser.error(f"{path}: no plans can be read there ({error}); make it with --save")
    if not isinstance(found, dict) or not all(isinstance(plan, dict) for plan in found.values()):
        parser.error(f"{path}: not a file that --save wrote")
    return found


def answers(
    work: Callable[[str, float], Plan], folders: List[Path], jobs: int, limit: float
) -> Tuple[Dict[str, Plan], Dict[str, float]]:
    """Do this with each checkout, that many at a time; return answers and seconds by the folders' names."""
    if CONTEXT.get_start_method() == "forkserver":
        CONTEXT.set_forkserver_preload(LOADED)
    with ThreadPoolExecutor(jobs) as pool:  # a thread only waits for its process
        done = pool.map(lambda folder: answer(work, folder, limit), folders)
        found = list(tqdm(done, total=len(folders), unit="checkout", disable=None))  # no bar where nobody looks
    names = [folder.name for folder in folders]
    return dict(zip(names, (one for one, _ in found))), dict(zip(names, (taken for _, taken in found)))


def plan(folder: Path, limit: float) -> Tuple[Plan, float]:
    """Plan a checkout in a process of its own; return the plan and the seconds it took."""
    return answer(_planned, folder, limit)


def answer(work: Callable[[str, float], Plan], folder: Path, limit: float) -> Tuple[Plan, float]:
    """Do this with a checkout in a process of its own; return the answer and the seconds it took."""
    started = time.perf_counter()
    here, there = CONTEXT.Pipe(duplex=False)
    child = CONTEXT.Process(target=_child, args=(work, str(folder), limit, there), daemon=True)
    child.start()
    there.close()
    found: Plan = {"error": f"no plan within {limit:g} s"}
    if here.poll(limit):
        try:
            found = here.recv()
        except EOFError:
            child.join()
            found = {"error": f"the process ended with exit code {child.exitcode}"}
    child.kill()
    child.join()
    return found, time.perf_counter() - started


def _child(work: Callable[[str, float], Plan], folder: str, limit: float, results: Connection) -> None:
    results.send(work(folder, limit))


def _planned(folder: str, _: float) -> Plan:
    return ablation.plan_of(folder)


def _masked(folder: str, _: float) -> Plan:
    return ablation.plan_of(folder, "--masks")


def _ablated(folder: str, limit: float) -> Plan:
    return ablation.Checkout(folder, 0.9 * limit).ablate()


def masks_in(plans: Dict[str, Plan]) -> str:
    """Count what `legs-patch --masks` does: terms, lines, and the checkouts in which no line is left to the user."""
    terms = [site.get("term") for found in plans.values() for site in found.get("sites", ())]
    by_hand = [
        sum(problem["reason"].startswith("not masked") for problem in found.get("problems", ()))
        for found in plans.values()
    ]
    return (
        f"terms weighted: {terms.count(None)}; lines that mask them: {terms.count('mask')} written, {sum(by_hand)} "
        f"left to the user; checkouts in which all are written: {by_hand.count(0)} of {len(plans)}"
    )


def compare(before: Dict[str, Plan], after: Dict[str, Plan], sites: bool = False) -> int:
    """Print the differences between the plans, checkout by checkout; return how many checkouts differ."""
    different = 0
    for name in sorted(set(before) | set(after)):
        old, new = (
            (edits(found[name]) if sites else found[name]) if name in found else None for found in (before, after)
        )
        if old == new:
            continue
        different += 1
        print(name)
        if old is None or new is None:
            print("  only after" if old is None else "  only before")
            continue
        for key in sorted(set(old) | set(new)):
            changes(key, old.get(key), new.get(key))
    return different


def changes(key: str, old: Any, new: Any) -> None:
    """Print the old and the new value of a plan's entry; of lists, only the elements that differ."""
    if old == new:
        return
    if not (isinstance(old, list) and isinstance(new, list)):
        old, new = [old], [new]
    for sign, some, others in (("-", old, new), ("+", new, old)):
        for element in some:
            if element not in others:
                print(f"  {sign} {key}: {json.dumps(element, sort_keys=True)}")
    if sorted(map(str, old)) == sorted(map(str, new)):
        print(f"  {key}: the same elements in another order")


def edits(found: Plan) -> Plan:
    """Return a plan's edits: call sites, the lines of problems, the exit code."""

    def places(key: str, *names: str) -> List[List[Any]]:
        return sorted(([entry.get(name) for name in names] for entry in found.get(key, [])), key=str)

    return {
        "exit": found.get("exit"),
        "error": found.get("error"),
        "sites": places("sites", "file", "line", "column", "channels_last"),
        "problems": places("problems", "file", "line"),
    }


if __name__ == "__main__":
    sys.exit(main())
