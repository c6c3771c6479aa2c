"""The CUDA backend on a CPU: all of its Python as it is, behind a libcuda and a libnvrtc that are compiled by g++.

The two libraries stand in for NVIDIA's: the driver class packs arguments, chooses contexts and meets errors as on a
GPU, and the kernels that it launches are legs.cu, compiled for the CPU.
"""

from __future__ import annotations

import atexit
import ctypes
import shlex
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, FrozenSet, List, NamedTuple, Optional, Sequence, Tuple

import torch

from legs_loss.kernels.cuda.backend import CudaBackend
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.modules import BinaryCache, Modules
from legs_loss.kernels.cuda.nvrtc import Compiler

__all__ = ["COMPILER", "TRIED", "EmulatedDriver", "Libraries", "RecordingDriver", "Runtime", "emulated", "libraries"]

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


class _Everything(FrozenSet[Any]):
    def __contains__(self, case: object) -> bool:
        return True


TRIED = _Everything()  # of an Availability: the trial of whatever is asked for has passed


class Libraries(NamedTuple):
    """libcuda and libnvrtc, as ctypes loads them, and a folder for compiled kernels."""

    cuda: Any
    nvrtc: Any
    cache: Path


@lru_cache(maxsize=None)
def libraries(flags: Sequence[str] = ()) -> Libraries:
    """Compile the two libraries, once in a process; ``flags`` are for g++ when it compiles kernels."""
    folder = Path(tempfile.mkdtemp(prefix="legs-emulated-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    found = []
    for name in ("libcuda", "libnvrtc"):
        path = folder / f"{name}.so"
        command = [str(COMPILER), "-O1", "-std=c++17", "-shared", "-fPIC", "-o", str(path), str(HERE / f"{name}.cpp")]
        subprocess.run([*command, "-ldl", "-pthread"], check=True)
        found.append(ctypes.CDLL(str(path)))
    command_of_kernels = " ".join(map(shlex.quote, [str(COMPILER), *FLAGS, *flags, str(HERE / "emulate.cpp")]))
    # Python's os.environ is not seen by a library that is loaded already where it copies; setenv is.
    ctypes.CDLL(None).setenv(b"LEGS_EMULATION_COMMAND", command_of_kernels.encode(), 1)
    found[0].test_calls.restype = ctypes.c_longlong
    return Libraries(found[0], found[1], folder / "kernels")


class Runtime:
    """The part of torch.cuda that the driver asks.

    Attributes:
        captures: whether the current stream is being captured.
        emptied: how often torch's cache was emptied.
    """

    def __init__(self, multiprocessors: int = 4, architecture: Tuple[int, int] = (8, 6)) -> None:
        major, minor = architecture
        self._properties = SimpleNamespace(major=major, minor=minor, multi_processor_count=multiprocessors)
        self.captures, self.emptied, self.stream = False, 0, 0

    def current_device(self) -> int:
        return 0

    def get_device_properties(self, index: int) -> Any:
        return self._properties

    def current_stream(self, index: int) -> Any:
        return SimpleNamespace(cuda_stream=self.stream)

    def is_current_stream_capturing(self) -> bool:
        return self.captures

    def empty_cache(self) -> None:
        self.emptied += 1


class RecordingDriver(CudaDriver):
    """A driver that keeps a list of its launches.

    Attributes:
        launches: name and number of blocks.
        backwards: run the threads of a phase from the last to the first; a GPU's run in its own order.
    """

    backwards = False

    def __init__(self, device: torch.device, *arguments: Any) -> None:
        super().__init__(device, *arguments)
        self.launches: List[Tuple[str, int]] = []

    def function(self, module: int, name: str) -> Any:
        return name, super().function(module, name)

    def launch(self, task: Any, *kernels: Any) -> None:
        self.launches += [(name, blocks) for (name, _), blocks, _ in kernels]
        super().launch(task, *[(own, blocks, threads) for (_, own), blocks, threads in kernels])


class EmulatedDriver(RecordingDriver):
    """The CPU in place of a GPU."""

    def __init__(self, multiprocessors: int = 4) -> None:
        self.cuda = libraries().cuda
        super().__init__(torch.device("cpu"), self.cuda, Runtime(multiprocessors))

    def launch(self, task: Any, *kernels: Any) -> None:
        self.cuda.test_reverse(int(self.backwards))
        super().launch(task, *kernels)


def emulated(driver: Optional[CudaDriver] = None, flags: Sequence[str] = ()) -> CudaBackend:
    """Return the CUDA backend for tensors on the CPU; this process's tests share its compiled kernels."""
    found = libraries(tuple(flags))
    modules = Modules(driver or EmulatedDriver(), Compiler(found.nvrtc), BinaryCache(found.cache))

    def opened(device: torch.device) -> Modules:
        assert device.type == "cpu"
        return modules

    return CudaBackend(opened)
