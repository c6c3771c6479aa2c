"""The CUDA backend that the kernels' tests try: emulated on the CPU, or with LEGS_TEST_DEVICE=cuda that of a GPU."""

from __future__ import annotations

import os
from typing import Any, Optional

import torch

from legs_loss.kernels.cuda.backend import CudaBackend
from legs_loss.kernels.cuda.modules import BinaryCache, Modules, cache_folder
from legs_loss.kernels.cuda.nvrtc import find_compiler
from tests.cuda_emulation import COMPILER, EmulatedDriver, RecordingDriver, emulated

__all__ = ["DEVICE", "MISSING", "new_backend", "new_driver"]

DEVICE = torch.device(os.environ.get("LEGS_TEST_DEVICE", "cpu"))
# Why the tests cannot run, or None.
MISSING: Optional[str] = "needs g++" if DEVICE.type == "cpu" and COMPILER is None else None


def new_driver(multiprocessors: Optional[int] = None) -> Any:
    """Return a driver of the device; the number of multiprocessors decides how the work is divided."""
    if DEVICE.type == "cpu":
        return EmulatedDriver() if multiprocessors is None else EmulatedDriver(multiprocessors)
    driver = RecordingDriver(DEVICE)
    driver.multiprocessors = multiprocessors or driver.multiprocessors
    return driver


def new_backend(driver: Optional[Any] = None) -> CudaBackend:
    """Return the backend for images on the device."""
    if DEVICE.type == "cpu":
        return emulated(driver)
    modules = Modules(driver or new_driver(), find_compiler(), BinaryCache(cache_folder()))
    return CudaBackend(lambda device: modules)
