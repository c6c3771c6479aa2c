"""Run an upstream training script without a GPU: CUDA calls redirected to the CPU, CUDA modules replaced by shims.

- torch_cuda/: replacements for torch.cuda and CUDA devices.
- modules/: one file per upstream module, named as it is imported.
- inria/: the common parts of the rasterizers of Inria's family, and one that adapts to an unknown fork.
- finder.py: the import hook that installs the shims.
"""

from __future__ import annotations

import atexit
import importlib.util
from contextlib import ExitStack
from pathlib import Path

from legs_adapters.shims.missing import MissingShim

__all__ = ["MissingShim", "start"]


def start(root: Path) -> None:
    """Replace CUDA in this process, for the codebase in ``root``, until the process ends."""
    from legs_adapters.shims import finder, nvidia_smi, torch_cuda
    from legs_adapters.shims.inria.survey import survey

    torch_cuda.redirect()
    nvidia_smi.offer()
    finder.install(finder.table_for(survey(root)))
    if importlib.util.find_spec("numba"):  # without it the rasterizer says what to install
        from legs_loss.lab.rasterizer import said

        compiling = ExitStack()
        compiling.enter_context(said("legs run", "20 to 100 s"))
        atexit.register(compiling.close)
