"""Describe a store of weight maps, and verify its checksums.

STORE is the folder that legs precompute wrote, or a scene with the folder legs_weights.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import Iterable

from legs_loss.system.terminal import say

HELP = "describe a store of weight maps, and verify it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("store", metavar="STORE", help="a store's folder, or the scene that has one")


def run(args: argparse.Namespace) -> int:
    """Print the summary; 1 when something is damaged."""
    from legs_loss.config import STORE_FOLDER
    from legs_loss.errors import LegsError
    from legs_loss.precompute.sharpness import unsharp_views
    from legs_loss.store import MANIFEST, MASK, WEIGHTS, DamagedStoreError, WeightStore

    path = Path(args.store)
    if (path / STORE_FOLDER).is_dir():
        path = path / STORE_FOLDER
    if not (path / MANIFEST).is_file():
        raise LegsError(_without_store(path))
    try:
        store = WeightStore(path)
    except DamagedStoreError as error:
        say(f"legs: error: {error}", sys.stderr)
        return 1
    entries = list(store.entries.values())
    damaged, orphans = store.check()
    say(path)
    say(f"  views      {len({entry.view for entry in entries})}")
    say(f"  maps       {len(entries)} ({sum(entry.bytes for entry in entries) / 1e6:.3g} MB)")
    say(f"  sizes      {_counted(f'{entry.width}x{entry.height}' for entry in entries)}")
    made = [entry for entry in entries if not entry.is_users]
    say(f"  operators  {_counted(f'{entry.operator} p={entry.p:g} eps={entry.eps:g}' for entry in made)}")
    if any(entry.background for entry in entries):
        say(f"  background {_counted(entry.background or 'none' for entry in entries)}")
    for kind in (MASK, WEIGHTS):
        users = store.of_kind(kind)
        if users:
            say(f"  {kind:<10} {len({entry.view for entry in users})} view(s) of your own")
    if not damaged:
        half = {entry.view for entry in store.of_kind(MASK) if store.user_map(entry).mean() < 0.5}
        if half:
            say(f"  masked by more than half: {', '.join(sorted(half))}")
        say(f"  unsharp    {', '.join(unsharp_views(store)) or 'none'}")
    say(f"  damaged    {len(damaged) or 'none'}")
    for entry in damaged:
        say(f"    {entry.view} {entry.width}x{entry.height} {entry.operator}: {entry.file}")
    if orphans:
        say(f"  leftovers  {len(orphans)} of interrupted runs; the next legs precompute removes them")
        for orphan in orphans:
            say(f"    {orphan}")
    if damaged:
        say("legs: error: run legs precompute again to repair the store", sys.stderr)
    return 1 if damaged else 0


def _without_store(path: Path) -> str:
    """Return the error message for a folder that is not a store."""
    from legs_loss.cli.shared.scene_arguments import read_noted
    from legs_loss.errors import LegsError
    from legs_loss.store import MANIFEST

    try:
        views = read_noted(path).views
    except LegsError as error:
        return f"{path} is neither a store of weight maps (it has no {MANIFEST}) nor a scene that can be read: {error}"
    return (
        f"{path} has {len(views)} photograph(s) and no weight maps yet: legs precompute {shlex.quote(str(path))} makes "
        "them; if the store is elsewhere, give its folder"
    )


def _counted(values: Iterable[str]) -> str:
    return ", ".join(f"{value} ({count})" for value, count in Counter(values).most_common()) or "none"
