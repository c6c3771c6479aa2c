"""Run a training script in the working folder, its steps in turns with those of others.

    python turns.py REPORT GATE NAMES NAME TURN [--cpu] SCRIPT ...

A step is the time from one call of `Tensor.backward` to the next. After TURN of them the GPU goes to the next of NAMES.
"""

from __future__ import annotations

import json
import os
import runpy
import sys
import time
from pathlib import Path
from typing import Any, List, Sequence

GLANCE = 0.001  # seconds between two looks at whose turn it is


class Gate:
    """Whose turn it is: a name in a file. ``NAME.there`` says that one waits, ``NAME.gone`` that it has left.

    A file ``open`` lets all go on side by side.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.folder, self.names = folder, names

    def ready(self) -> bool:
        """Return whether all are there or gone."""
        return all((self.folder / f"{name}.there").exists() or self._gone(name) for name in self.names)

    def begin(self) -> None:
        """Give the first its turn."""
        self._give(self.names[-1])

    def wait(self, name: str) -> None:
        """Wait for a turn."""
        (self.folder / f"{name}.there").touch()
        while not (self.folder / "open").exists() and self._whose() != name:
            time.sleep(GLANCE)

    def pass_on(self, name: str) -> None:
        """End a turn."""
        if self._whose() == name:
            self._give(name)

    def leave(self, name: str) -> None:
        """Say that one has ended, and pass its turn on."""
        (self.folder / f"{name}.gone").touch()
        self.pass_on(name)

    def _gone(self, name: str) -> bool:
        return (self.folder / f"{name}.gone").exists()

    def _whose(self) -> str:
        try:
            return (self.folder / "turn").read_text(encoding="utf-8")
        except FileNotFoundError:
            return ""

    def _give(self, after: str) -> None:
        place = self.names.index(after) + 1
        others = [name for name in (*self.names[place:], *self.names[:place]) if not self._gone(name)]
        if others:
            part = self.folder / "turn.part"
            part.write_text(others[0], encoding="utf-8")
            part.replace(self.folder / "turn")


def main(report: str, folder: str, names: str, name: str, turn: str, *words: str) -> None:
    """Run the script; the report is written after every turn."""
    import torch

    if words[0] == "--cpu":
        from legs_adapters.shims import start

        words = words[1:]
        start(Path.cwd())
    gate, length = Gate(Path(folder), names.split(",")), int(turn)
    backward = torch.Tensor.backward
    stamps: List[float] = []
    began = 0.0
    found: Any = {"steps": 0, "seconds": 0.0, "ms a step by turn": []}

    def end_turn() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        if len(stamps) > 1:
            found["seconds"] += time.perf_counter() - began
            found["ms a step by turn"].append(1e3 * (stamps[-1] - stamps[0]) / (len(stamps) - 1))
            found["peak MB"] = torch.cuda.max_memory_allocated() / 1e6 if torch.cuda.is_available() else None
        Path(report).write_text(json.dumps(found), encoding="utf-8")
        stamps.clear()
        gate.pass_on(name)

    def stamped(self: torch.Tensor, *args: Any, **settings: Any) -> Any:
        nonlocal began
        if found["steps"] % length == 0:
            end_turn()
            gate.wait(name)
            began = time.perf_counter()
        found["steps"] += 1
        stamps.append(time.perf_counter())
        return backward(self, *args, **settings)

    torch.Tensor.backward = stamped  # type: ignore[method-assign,assignment]
    sys.argv = list(words)
    sys.path.insert(0, os.getcwd())
    try:
        runpy.run_path(words[0], run_name="__main__")
    finally:
        end_turn()
        gate.leave(name)


if __name__ == "__main__":
    del sys.path[0]  # this folder: its modules are none of the codebase's
    main(*sys.argv[1:])
