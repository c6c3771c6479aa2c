"""Count how often a reader must go back: follow legs-patch through its own files while it runs.

A walk lists files in the order in which they are first entered. Where a new file is entered from another file than the
one before it, the stack has gone back down to a file that it had left: one return.

    python benchmarks/walks.py CHECKOUT

Two walks are traced, each within its own layer: `cli` from argv to the written files (the modules at the top, and
checkout/), and `verdict`, the first form through the rules (rules/ and terms/). The checkout is copied first.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shutil
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any, List, Optional, Tuple

import legs_adapters
from legs_adapters import cli

ROOT = Path(legs_adapters.__file__).parent
MOST = 12


class Walk:
    """Follow the calls between the files of one layer.

    Args:
        folders: the layer's folders in legs_adapters; "" are the modules at the top.
        start: the file whose first method begins the walk, which ends when that returns; empty: the whole run.
    """

    def __init__(self, folders: List[str], start: str = "") -> None:
        self.steps: List[Tuple[str, str]] = []  # a file, and the one that it was first entered from
        self._folders, self._start = folders, start
        self._first: Optional[FrameType] = None
        self._seen = {""}

    @property
    def returns(self) -> List[Tuple[str, str]]:
        """The steps that are not taken from the file before."""
        before = [""] + [file for file, _ in self.steps]
        return [step for step, last in zip(self.steps, before) if step[1] not in ("", last)]

    def trace(self, frame: FrameType, event: str, argument: Any) -> None:
        if event == "return" and frame is self._first:
            self._start = "over"
        if event != "call" or self._start == "over":
            return
        file = self._file_of(frame)
        if self._start and self._first is None and file == self._start and not frame.f_code.co_name.startswith("_"):
            self._first = frame
        if file not in self._seen and not (self._start and self._first is None):
            self._seen.add(file)
            outer = frame.f_back
            while outer is not None and not self._file_of(outer):
                outer = outer.f_back
            self.steps.append((file, self._file_of(outer) if outer is not None and frame is not self._first else ""))

    def _file_of(self, frame: FrameType) -> str:
        path = Path(frame.f_code.co_filename)
        inside = ROOT in path.parents and frame.f_code.co_name != "<module>"
        folder = path.relative_to(ROOT).parts[0] if inside and path.parent != ROOT else ""
        return path.relative_to(ROOT).as_posix() if inside and folder in self._folders else ""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, metavar="CHECKOUT")
    args = parser.parse_args()
    walks = {"cli": Walk(["", "checkout"]), "verdict": Walk(["rules", "terms"], "rules/verdict.py")}
    for name, walk in walks.items():
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "checkout"
            shutil.copytree(args.checkout, root, ignore=shutil.ignore_patterns(".git"), symlinks=True)
            sys.setprofile(walk.trace)
            with contextlib.redirect_stdout(io.StringIO()):
                cli.main([str(root)])
            sys.setprofile(None)
        print(f"{name}: {len(walk.steps)} files, {len(walk.returns)} returns (at most {MOST})")
        for file, caller in walk.steps:
            print(
                f"  {'<- ' if (file, caller) in walk.returns else '   '}{file}" + (f"  from {caller}" if caller else "")
            )
    return int(any(len(walk.returns) > MOST for walk in walks.values()))


if __name__ == "__main__":
    raise SystemExit(main())
