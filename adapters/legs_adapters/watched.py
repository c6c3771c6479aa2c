"""Run a training script and record every backward pass of a scalar, and what ``legs_loss.l1_loss`` counted.

The process that ``legs-patch --verify`` starts for each of its runs.
"""

from __future__ import annotations

import json
import random
import sys
import time
from pathlib import Path
from typing import Any, List

from legs_loss.cli import exit_code


def _main(path: str, limit: str, root: str, script: str, *arguments: str) -> int:
    """Run a script and write the fields of a `Run` to a file, also after an error."""
    import numpy as np
    import torch

    from legs_adapters.runner import execute
    from legs_loss.runtime import counts

    losses: List[str] = []
    times: List[float] = []
    own_backward = torch.Tensor.backward

    def backward(tensor: Any, *args: Any, **kwargs: Any) -> Any:
        if tensor.numel() == 1:
            if len(losses) >= int(limit):
                sys.exit()  # the runner lets it pass, like the script's own
            losses.append(float(tensor.detach()).hex())
            times.append(time.perf_counter())
        return own_backward(tensor, *args, **kwargs)

    torch.Tensor.backward = backward  # type: ignore
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    try:
        return exit_code("legs", lambda: execute(script, arguments, {}, Path(root)))
    finally:
        counted = {name: getattr(counts(), name) for name in ("weighted", "plain", "stored", "computed", "remembered")}
        seconds = [after - before for before, after in zip(times, times[1:])]
        Path(path).write_text(json.dumps({"losses": losses, "seconds": seconds, **counted}))


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
