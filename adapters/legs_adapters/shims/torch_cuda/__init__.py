"""Run a script's CUDA calls on the CPU: functions of torch are wrapped once, in place.

A ``TorchFunctionMode`` does not work: it is off inside the backward functions of custom autograd and in other threads,
and never sees ``torch.load``, ``torch.Generator`` or ``torch.cuda.FloatTensor``. Every replacement is a separate
object, since torch._dynamo identifies objects by identity.
"""

from __future__ import annotations

from legs_adapters.shims.torch_cuda import devices, optimisers, runtime, tensors, workers
from legs_adapters.shims.torch_cuda.redirection import Redirection

__all__ = ["Redirection", "redirect"]


def redirect() -> Redirection:
    """Replace CUDA until the result's ``restore()``."""
    redirection = Redirection()
    for part in (tensors, devices, runtime, workers, optimisers):
        part.redirect(redirection)
    return redirection
