"""Run an upstream training script without a GPU: CUDA calls redirected to the CPU, CUDA modules replaced by shims.

- torch_cuda/: what a script asks of torch.cuda and of CUDA devices.
- modules/: one file an upstream module, named as it is imported.
- inria/: what the rasterizers of Inria's family share, and the one that fits itself to an unknown fork.
- finder.py: the import hook that puts the shims in.
"""

from __future__ import annotations

from pathlib import Path

from legs_adapters.shims.missing import MissingShim

__all__ = ["MissingShim", "start"]


def start(root: Path) -> None:
    """Answer for CUDA in this process, for the codebase in ``root``, until it ends."""
    from legs_adapters.shims import finder, nvidia_smi, torch_cuda
    from legs_adapters.shims.inria.survey import survey

    torch_cuda.redirect()
    nvidia_smi.offer()
    finder.install(finder.table_for(survey(root)))
