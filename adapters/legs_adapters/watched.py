"""Run a training script and record every backward pass of a scalar, and every call of ``legs_loss.l1_loss``.

The process that ``legs-patch --verify`` starts for each of its runs.
"""

from __future__ import annotations

import json
import random
import sys
import time
from pathlib import Path
from typing import Any, Dict, List

from legs_loss import LegsError
from legs_loss.system import say_error

__all__ = ["watch"]


class _Enough(SystemExit):
    """Ends the script after the requested steps; the runner lets it pass, like the script's own exit."""


class watch:
    """Record the training of this process: every backward pass of a scalar, and every call of the two losses."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.losses: List[str] = []
        self.times: List[float] = []
        self.without_gradient = 0
        self.ssims = 0

    def __enter__(self) -> watch:
        import torch

        import legs_loss
        from legs_loss.runtime import counts

        self._backward, self._l1_loss, self._ssim = torch.Tensor.backward, legs_loss.l1_loss, legs_loss.ssim

        def backward(tensor: Any, *args: Any, **kwargs: Any) -> Any:
            if tensor.numel() == 1:
                if len(self.losses) >= self.limit:
                    raise _Enough
                self.losses.append(float(tensor.detach()).hex())
                self.times.append(time.perf_counter())
            return self._backward(tensor, *args, **kwargs)

        def l1_loss(*args: Any, **kwargs: Any) -> Any:
            before = counts().weighted
            result = self._l1_loss(*args, **kwargs)
            self.without_gradient += counts().weighted - before if not torch.is_grad_enabled() else 0
            return result

        def ssim(*args: Any, **kwargs: Any) -> Any:
            self.ssims += torch.is_grad_enabled()
            return self._ssim(*args, **kwargs)

        torch.Tensor.backward = backward  # type: ignore
        legs_loss.l1_loss, legs_loss.ssim = l1_loss, ssim
        return self

    def __exit__(self, *_: Any) -> None:
        import torch

        import legs_loss

        torch.Tensor.backward = self._backward  # type: ignore[method-assign]
        legs_loss.l1_loss, legs_loss.ssim = self._l1_loss, self._ssim

    def report(self) -> Dict[str, Any]:
        """Return the fields of a `Run` that were recorded in this process."""
        from legs_loss.runtime import counts

        found = counts()
        return {
            "losses": self.losses,
            "seconds": [after - before for before, after in zip(self.times, self.times[1:])],
            "weighted": found.weighted,
            "weighted_without_gradient": self.without_gradient,
            "plain": found.plain,
            "stored": found.stored,
            "computed": found.computed,
            "remembered": found.remembered,
            "ssims": self.ssims,
        }


def _main(report: str, limit: str, root: str, script: str, *arguments: str) -> int:
    """Run a script and write the record to a file, also after an error."""
    import numpy as np
    import torch

    from legs_adapters.runner import execute

    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    with watch(int(limit)) as seen:
        try:
            return execute(script, arguments, {}, Path(root))
        except _Enough:
            return 0
        except LegsError as error:
            say_error("legs", error)
            return 2
        finally:
            Path(report).write_text(json.dumps(seen.report()))


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
