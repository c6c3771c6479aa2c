"""Say how torch and the libraries around it pass an ``nn.Module`` on: they move it, wrap it, return it."""

from __future__ import annotations

from legs_adapters.code.members import Conventions
from legs_adapters.code.syntax import word_set

__all__ = ["TORCH"]

TORCH = Conventions(
    returning_self=word_set("cuda cpu to half float double eval train requires_grad_"),
    # Lightning's fabric.setup, accelerate's prepare
    wrapping=word_set("DataParallel DistributedDataParallel DDP compile convert_sync_batchnorm prepare fabric.setup"),
    common=word_set(
        """
        to cuda cpu clone detach mean sum size step zero_grad train eval item view reshape permute squeeze unsqueeze
        clamp
        """
    ),
)
