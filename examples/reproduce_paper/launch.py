"""Run one script of a codebase with a given seed, and report what was weighted.

    python launch.py REPORT SEED [--robust JSON] [--cpu] SCRIPT ...

3DGS and its forks set their seeds to 0 in their code. Here a multiple of SEED is added to every seed that is set,
so that runs with the same SEED agree and others differ; 0 keeps the script's own. The report is written at the end.
With --robust the masks of a patched script are those that a RobustMask of these settings makes.
It ends when the comparison that started it does, however that was killed.
"""

from __future__ import annotations

import json
import os
import random
import sys
import threading
import time
import zlib
from pathlib import Path
from typing import Any, Callable

STRIDE = 1_000_003  # between the seeds of two runs: a script that counts its seeds up meets none twice


def move_seeds(seed: int) -> None:
    """Add a multiple of ``seed`` to every seed that is set from now on."""
    import numpy as np
    import torch

    def moved(function: Callable[..., Any], limit: int) -> Callable[..., Any]:
        def seeded(*args: Any, **kwargs: Any) -> Any:
            given = [*args[:1], *(kwargs.pop(name) for name in ("a", "seed") if name in kwargs), None][0]
            return function((_number(given) + seed * STRIDE) % limit, *args[1:], **kwargs)

        return seeded

    # For scripts that set no seed.
    for module, name, limit in (
        (random, "seed", 1 << 63),
        (np.random, "seed", 1 << 32),
        (torch, "manual_seed", 1 << 63),
        (torch.random, "manual_seed", 1 << 63),
        (torch.cuda, "manual_seed", 1 << 63),
        (torch.cuda, "manual_seed_all", 1 << 63),
    ):
        function = moved(getattr(module, name), limit)
        setattr(module, name, function)
        if not name.startswith("manual_seed_all") and module is not torch.cuda:
            function(0)


def _number(given: Any) -> int:
    """Return a seed as a number: 0 for none, a checksum for what is no number."""
    try:
        return 0 if given is None else int(given)
    except (TypeError, ValueError):
        return zlib.crc32(repr(given).encode())


def _end_with(parent: int) -> None:
    """End this process once its parent has: at once, since nobody reads what it would still write."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def main(report: str, seed: str, *words: str) -> int:
    """Run the script by `legs run`, and write the report, also after an error."""
    from legs_loss.cli import main as legs

    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    if "--cpu" in words:  # as `legs run --cpu` does, before torch is imported: here the seeds import it
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    move_seeds(int(seed))
    if words[0] == "--robust":
        import legs_loss
        from examples.reproduce_paper.robust import RobustMask

        legs_loss.masked = RobustMask(**json.loads(words[1]))
        words = words[2:]
    started = time.perf_counter(), time.process_time()
    try:
        return legs(["run", *words])
    finally:
        from legs_loss.runtime import counts

        found = counts()
        Path(report).write_text(
            json.dumps(
                {
                    "weighted": found.weighted,
                    "plain": found.plain,
                    "seconds": time.perf_counter() - started[0],
                    "processor_seconds": time.process_time() - started[1],
                }
            ),
            encoding="utf-8",
        )


if __name__ == "__main__":
    del sys.path[0]  # this folder: its modules are none of the codebase's
    sys.exit(main(*sys.argv[1:]))
