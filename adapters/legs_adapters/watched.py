"""Run a training script and record every backward pass of a scalar, and every call of ``legs_loss.l1_loss``.

The process that ``legs-patch --verify`` starts for each of its runs.
"""

from __future__ import annotations

import json
import random
import sys
import time
from pathlib import Path
from typing import Any, Callable, Dict, List

from legs_loss import LegsError
from legs_loss.system import say_error


class _Enough(SystemExit):
    """Ends the script after the requested steps; the runner lets it pass, like the script's own exit."""


def _watch(limit: int) -> Callable[[], Dict[str, Any]]:
    """Record the training of this process from now on; return a function that returns the fields of a `Run`."""
    import torch

    import legs_loss
    from legs_loss.runtime import counts

    losses: List[str] = []
    times: List[float] = []
    seen = {"weighted_without_gradient": 0, "ssims": 0}
    own_backward, own_l1_loss, own_ssim = torch.Tensor.backward, legs_loss.l1_loss, legs_loss.ssim

    def backward(tensor: Any, *args: Any, **kwargs: Any) -> Any:
        if tensor.numel() == 1:
            if len(losses) >= limit:
                raise _Enough
            losses.append(float(tensor.detach()).hex())
            times.append(time.perf_counter())
        return own_backward(tensor, *args, **kwargs)

    def l1_loss(*args: Any, **kwargs: Any) -> Any:
        before = counts().weighted
        result = own_l1_loss(*args, **kwargs)
        if not torch.is_grad_enabled():
            seen["weighted_without_gradient"] += counts().weighted - before
        return result

    def ssim(*args: Any, **kwargs: Any) -> Any:
        seen["ssims"] += torch.is_grad_enabled()
        return own_ssim(*args, **kwargs)

    def report() -> Dict[str, Any]:
        counted = {name: getattr(counts(), name) for name in ("weighted", "plain", "stored", "computed", "remembered")}
        seconds = [after - before for before, after in zip(times, times[1:])]
        return {"losses": losses, "seconds": seconds, **counted, **seen}

    torch.Tensor.backward = backward  # type: ignore
    legs_loss.l1_loss, legs_loss.ssim = l1_loss, ssim
    return report


def _main(path: str, limit: str, root: str, script: str, *arguments: str) -> int:
    """Run a script and write the record to a file, also after an error."""
    import numpy as np
    import torch

    from legs_adapters.runner import execute

    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    report = _watch(int(limit))
    try:
        return execute(script, arguments, {}, Path(root))
    except _Enough:
        return 0
    except LegsError as error:
        say_error("legs", error)
        return 2
    finally:
        Path(path).write_text(json.dumps(report()))


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
