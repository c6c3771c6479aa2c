"""Run a training script and record: the process of ``legs-patch --trace``, and of each run of ``--verify``.

    python -m legs_adapters.trace.child '{"report": PATH, "root": CHECKOUT, ...}' train.py ARGUMENTS

What is recorded: every difference under a loss, the loss of every backward pass, what ``legs_loss.l1_loss`` counted.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing.spawn
import os
import random
import shutil
import signal
import sys
import threading
import time
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Dict, List

from legs_loss.cli import exit_code
from legs_loss.system import is_first_process, is_held

_over: List[bool] = []  # one for each time that enough was seen


def _main(given: str, script: str, *arguments: str) -> int:
    """Run a script and write the report to a file, also after an error."""
    import numpy as np
    import torch

    from legs_adapters.runner import execute, run_exit_functions

    spec = json.loads(given)
    threading.Thread(target=_end_with_parent, args=(spec,), daemon=True).start()
    _watched(spec)
    if "losses" in spec["limits"]:  # runs are compared
        random.seed(0)
        np.random.seed(0)
        torch.manual_seed(0)
    try:
        return exit_code("legs", lambda: execute(script, arguments, {}, Path(spec["root"]) if spec["cpu"] else None))
    finally:
        if _over:  # whatever threads of the script are left
            run_exit_functions()
            os._exit(0)


def _end_with_parent(spec: Dict[str, Any]) -> None:
    """Wait until nobody holds the parent's lock; then delete what it left, and end all processes of the script."""
    lock = f"{spec['report']}.lock"
    while os.path.exists(lock) and is_held(lock):
        time.sleep(1.0)
    shutil.rmtree(spec["work"], ignore_errors=True)
    os.killpg(0, signal.SIGKILL) if os.name == "posix" else os._exit(1)


class _Spawned:
    """Unpickled it watches the process: one that the script spawns, before that does anything else."""

    def __init__(self, spec: Dict[str, Any]) -> None:
        self.spec = spec

    def __reduce__(self) -> Any:
        # (This module is __main__ here, and not there.)
        return importlib.import_module("legs_adapters.trace.child")._watched, (dict(self.spec, spawned=True),)


def _watched(spec: Dict[str, Any]) -> None:
    """Watch this process, and write the report when it ends.

    Of several processes the one that saw steps writes it; of several of those rank 0.
    """
    from legs_adapters.trace.photographs import Photographs
    from legs_adapters.trace.watching import Watch

    def ended() -> None:
        _over.append(True)
        write()  # before Python 3.9 a spawned process forgets what it was to call at its end
        if spec.get("spawned") and os.name == "posix" and is_first_process():
            os.killpg(0, signal.SIGKILL)  # a rank that waits for one that has ended aborts, and the script would say so
        if len(_over) > 1:  # the script went on
            os._exit(0)
        sys.exit(0)  # (without the 0, a process of multiprocessing fails before Python 3.8)

    def write() -> None:
        if is_first_process() and (watch.seen["steps"] or not os.path.exists(spec["report"])):
            Path(spec["report"]).write_text(json.dumps({"is_over": bool(_over), **watch.report()}))

    photographs = Photographs(spec["folders"], spec["photos"])
    watch = Watch(spec["root"], photographs, spec["limits"], ended)
    watch.install()
    Finalize(None, write, exitpriority=0)  # a process that multiprocessing starts has no atexit
    start: Any = multiprocessing.spawn
    prepare = start.get_preparation_data
    start.get_preparation_data = lambda name: dict(prepare(name), legs_trace=_Spawned(spec))


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
