"""The CUDA backend that the kernels' tests try: emulated on the CPU, or with LEGS_TEST_DEVICE=cuda that of a GPU."""

from __future__ import annotations

import os
from typing import Any, List, Optional, Tuple

import torch

from legs_loss.kernels.cuda.backend import CudaBackend
from legs_loss.kernels.cuda.cache import BinaryCache, cache_folder
from legs_loss.kernels.cuda.driver import CudaDriver
from legs_loss.kernels.cuda.modules import Modules
from legs_loss.kernels.cuda.nvrtc import find_compiler
from tests.cuda_emulation import COMPILER, EmulatedDriver, emulated

__all__ = ["DEVICE", "MISSING", "new_backend", "new_driver"]

DEVICE = torch.device(os.environ.get("LEGS_TEST_DEVICE", "cpu"))
# Why the tests cannot run, or None.
MISSING: Optional[str] = "needs g++" if DEVICE.type == "cpu" and COMPILER is None else None


class RecordingDriver(CudaDriver):
    """A GPU's driver that keeps a list of its launches, as EmulatedDriver does.

    Attributes:
        launches: name and number of blocks.
        backwards: nothing here: a GPU's threads run in its own order.
    """

    def __init__(self) -> None:
        super().__init__(DEVICE)
        self.launches: List[Tuple[str, int]] = []
        self.backwards = False

    def function(self, module: Any, name: str) -> Any:
        return name, super().function(module, name)

    def launch(self, function: Any, blocks: int, threads: int, task: Any) -> None:
        name, own = function
        self.launches.append((name, blocks))
        super().launch(own, blocks, threads, task)


def new_driver(multiprocessors: Optional[int] = None) -> Any:
    """Return a driver of the device; the number of multiprocessors decides how the work is divided."""
    if DEVICE.type == "cpu":
        return EmulatedDriver() if multiprocessors is None else EmulatedDriver(multiprocessors)
    driver = RecordingDriver()
    driver.multiprocessors = multiprocessors or driver.multiprocessors
    return driver


def new_backend(driver: Optional[Any] = None) -> CudaBackend:
    """Return the backend for images on the device."""
    if DEVICE.type == "cpu":
        return emulated(driver)
    modules = Modules(driver or new_driver(), find_compiler(), BinaryCache(cache_folder()))
    return CudaBackend(lambda device: modules)
