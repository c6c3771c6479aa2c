"""Run a training script and record: the process of ``legs-patch --trace``, and of each run of ``--verify``.

    python -m legs_adapters.trace.child '{"report": PATH, "root": CHECKOUT, ...}' train.py ARGUMENTS

Of --verify: every backward pass of a scalar, and what ``legs_loss.l1_loss`` counted; of --trace: every difference.
"""

from __future__ import annotations

import atexit
import importlib
import json
import multiprocessing.spawn
import os
import random
import sys
import time
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Callable, Dict, List

from legs_loss.cli import exit_code
from legs_loss.system import is_first_process

Content = Callable[[], Dict[str, Any]]
_over: List[bool] = []  # one for each time that a trace saw enough


def _main(given: str, script: str, *arguments: str) -> int:
    """Run a script and write the report to a file, also after an error."""
    import torch  # noqa: F401  before its functions are wrapped

    from legs_adapters.runner import execute

    spec = json.loads(given)
    if "steps" in spec:
        _tracing(spec)
    else:
        _verifying(spec)
    try:
        return exit_code("legs", lambda: execute(script, arguments, {}, Path(spec["root"]) if spec["cpu"] else None))
    finally:
        if _over:  # whatever threads of the script are left
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(0)


def _report(path: str, content: Content) -> Callable[[], None]:
    """Write the report when the process ends, or the function that is returned is called.

    Of several processes the one that saw steps writes it; of several of those rank 0.
    """

    def write() -> None:
        found = content()
        if is_first_process() and (found.get("steps", 1) or not os.path.exists(path)):
            Path(path).write_text(json.dumps(found))

    Finalize(None, write, exitpriority=0)  # a process that multiprocessing starts has no atexit
    return write


class _Spawned:
    """Unpickled it watches the process: one that the script spawns, before that does anything else."""

    def __init__(self, spec: Dict[str, Any]) -> None:
        self.spec = spec

    def __reduce__(self) -> Any:
        return importlib.import_module("legs_adapters.trace.child")._tracing, (self.spec,)  # (here it is __main__'s)


def _tracing(spec: Dict[str, Any]) -> None:
    from legs_adapters.trace.photographs import Photographs
    from legs_adapters.trace.watching import Watch

    def ended() -> None:
        _over.append(True)
        write()  # before Python 3.9 a spawned process forgets what it was to call at its end
        if len(_over) > 1:  # the script went on
            os._exit(0)
        sys.exit(0)  # (without the 0, a process of multiprocessing fails before Python 3.8)

    def content() -> Dict[str, Any]:
        names = ("steps", "backward_passes", "failure")
        found = {name: getattr(watch, name) for name in names}
        found.update(unseen=sorted(watch.unseen), scripted=sorted(watch.scripted))
        return {"terms": list(watch.terms.values()), "is_over": bool(_over), **found}

    watch = Watch(spec["root"], Photographs(spec["folders"], spec["photos"]), spec["steps"], ended)
    watch.install()
    write = _report(spec["report"], content)
    start: Any = multiprocessing.spawn
    prepare = start.get_preparation_data
    start.get_preparation_data = lambda name: dict(prepare(name), legs_trace=_Spawned(spec))


def _verifying(spec: Dict[str, Any]) -> None:
    import numpy as np
    import torch

    from legs_loss.runtime import counts

    losses: List[str] = []
    times: List[float] = []
    own_backward = torch.Tensor.backward

    def backward(tensor: Any, *args: Any, **kwargs: Any) -> Any:
        if tensor.numel() == 1:
            if len(losses) >= spec["iterations"]:
                sys.exit()  # the runner lets it pass, like the script's own
            losses.append(float(tensor.detach()).hex())
            times.append(time.perf_counter())
        return own_backward(tensor, *args, **kwargs)

    def content() -> Dict[str, Any]:
        counted = {name: getattr(counts(), name) for name in ("weighted", "plain", "stored", "computed", "remembered")}
        return {"losses": losses, "seconds": [b - a for a, b in zip(times, times[1:])], **counted}

    torch.Tensor.backward = backward  # type: ignore
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    _report(spec["report"], content)


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
