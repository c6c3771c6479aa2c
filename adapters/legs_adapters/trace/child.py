"""Run a training script and record: the process of ``legs-patch --trace``, and of each run of ``--verify``.

    python -m legs_adapters.trace.child '{"report": PATH, "root": CHECKOUT, ...}' train.py ARGUMENTS

Of --verify: every backward pass of a scalar, and what ``legs_loss.l1_loss`` counted; of --trace: every difference.
"""

from __future__ import annotations

import atexit
import json
import os
import random
import sys
import time
from pathlib import Path
from typing import Any, Callable, Dict, List

from legs_loss.cli import exit_code
from legs_loss.system import is_first_process

Content = Callable[[], Dict[str, Any]]


def _main(given: str, script: str, *arguments: str) -> int:
    """Run a script and write the report to a file, also after an error."""
    import torch  # noqa: F401  before its functions are wrapped

    from legs_adapters.runner import execute

    spec = json.loads(given)
    root = Path(spec["root"])
    content = _tracing(spec) if "steps" in spec else _verifying(spec)
    code = 1
    try:
        code = exit_code("legs", lambda: execute(script, arguments, {}, root if spec["cpu"] else None))
    finally:
        if is_first_process():
            Path(spec["report"]).write_text(json.dumps(content()))
    if content().get("is_over"):  # whatever threads of the script are left
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return code


def _tracing(spec: Dict[str, Any]) -> Content:
    from legs_adapters.trace.photographs import Photographs
    from legs_adapters.trace.watching import Watch

    over: List[bool] = []

    def ended() -> None:
        over.append(True)
        if len(over) > 1:  # the script went on
            Path(spec["report"]).write_text(json.dumps(content()))
            os._exit(0)
        sys.exit()

    def content() -> Dict[str, Any]:
        terms = list(watch.terms.values())
        counts: Dict[str, Any] = {
            "steps": watch.steps,
            "backward_passes": watch.backward_passes,
            "files": len(watch.photographs),
        }
        counts["failure"] = watch.failure
        return {"terms": terms, "is_over": bool(over), **counts}

    watch = Watch(spec["root"], Photographs(spec["folders"], spec["photos"]), spec["steps"], ended)
    watch.install()
    return content


def _verifying(spec: Dict[str, Any]) -> Content:
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
    return content


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
