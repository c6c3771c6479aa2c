"""The CUDA backend on a CPU: its Python layer as it is, its kernels' source compiled with g++.

:class:`Gpp` stands in for NVRTC and :class:`EmulatedDriver` for the CUDA driver; what is between them and the loss is
the product's own: variants, cache, packing of arguments, grids, strides, scaling in backward.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, List, Optional, Sequence, Tuple

import torch

from legs_loss.kernels.cuda.backend import CudaBackend
from legs_loss.kernels.cuda.cache import BinaryCache
from legs_loss.kernels.cuda.launch import THREADS, Task
from legs_loss.kernels.cuda.modules import Modules
from legs_loss.kernels.cuda.nvrtc import Compiled

COMPILER = shutil.which("g++")
# Locals start as a large negative number, so that what is read before it is written shows.
FLAGS = [
    "-O2",
    "-std=c++17",
    "-march=native",
    "-ffp-contract=off",
    "-ftrivial-auto-var-init=pattern",
    "-shared",
    "-fPIC",
]
HERE = Path(__file__).parent


class Gpp:
    """g++ in place of NVRTC."""

    version = "emulated"

    def __init__(self, flags: Sequence[str] = ()) -> None:
        self.flags = [*FLAGS, *flags]
        self.compiled = 0

    def target(self, architecture: int) -> str:
        return f"sm_{architecture}"

    def compile(self, source: bytes, options: Sequence[str], target: str) -> Compiled:
        self.compiled += 1
        with tempfile.TemporaryDirectory() as folder:
            text, binary = Path(folder) / "legs.cu", Path(folder) / "legs.so"
            text.write_bytes(source)
            macros = [f'-DSOURCE="{text}"', *(option for option in options if option.startswith("-D"))]
            command = [str(COMPILER), *self.flags, *macros, "-o", str(binary), str(HERE / "emulate.cpp")]
            subprocess.run(command, check=True)
            return Compiled(binary.read_bytes(), "")


class EmulatedDriver:
    """The CPU in place of a GPU.

    Attributes:
        launches: what was launched: name and number of blocks.
        backwards: run the threads of a phase from the last to the first.
        captures: what ``capturing`` says.
    """

    architecture = 86

    def __init__(self, multiprocessors: int = 4) -> None:
        self.multiprocessors = multiprocessors
        self.launches: List[Tuple[str, int]] = []
        self.backwards = False
        self.captures = False
        self.loaded = 0

    def load(self, binary: bytes) -> Any:
        self.loaded += 1
        handle, name = tempfile.mkstemp(suffix=".so")
        with os.fdopen(handle, "wb") as file:
            file.write(binary)
        library = ctypes.CDLL(name)
        os.unlink(name)
        library.size_of_task.restype = ctypes.c_ulonglong
        assert library.size_of_task() == ctypes.sizeof(Task)
        return library

    def function(self, module: Any, name: str) -> Any:
        return name, getattr(module, name)

    def launch(self, function: Any, blocks: int, threads: int, task: Task) -> None:
        assert threads == THREADS and 0 < blocks < 2**31
        name, run = function
        self.launches.append((name, blocks))
        run(ctypes.c_longlong(blocks), ctypes.byref(task), int(self.backwards))

    def capturing(self) -> bool:
        return self.captures


_CACHE: Optional[Path] = None


def emulated(driver: Optional[EmulatedDriver] = None) -> CudaBackend:
    """Return the CUDA backend for tensors on the CPU; this process's tests share its compiled kernels."""
    global _CACHE
    if _CACHE is None:
        _CACHE = Path(tempfile.mkdtemp(prefix="legs-emulated-"))
    modules = Modules(driver or EmulatedDriver(), Gpp(), BinaryCache(_CACHE))

    def opened(device: torch.device) -> Modules:
        assert device.type == "cpu"
        return modules

    return CudaBackend(opened)
