"""Answer on the CPU what a script asks of CUDA devices: functions of torch are wrapped once, in place.

A ``TorchFunctionMode`` does not serve: it is off inside the backward functions of custom autograd and in other threads,
and never sees ``torch.load``, ``torch.Generator`` or ``torch.cuda.FloatTensor``. Every replacement is an object of its
own, since torch._dynamo holds objects by identity.
"""

from __future__ import annotations

from legs_adapters.shims.torch_cuda import devices, runtime, tensors, workers
from legs_adapters.shims.torch_cuda.redirection import Redirection

__all__ = ["Redirection", "redirect"]


def redirect() -> Redirection:
    """Answer for CUDA from now on, until the result's ``restore()``."""
    redirection = Redirection()
    for part in (tensors, devices, runtime, workers):
        part.redirect(redirection)
    return redirection
