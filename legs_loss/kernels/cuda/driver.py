"""Load and launch kernels: the CUDA driver's functions, called through ctypes, in torch's context."""

from __future__ import annotations

import ctypes
import sys
from contextlib import contextmanager
from typing import Any, Iterator, Optional

import torch

__all__ = ["CudaDriver", "DriverError", "load_library"]


class DriverError(Exception):
    """The CUDA driver returned an error; the message names the function and the reason."""


def load_library(platform: str = sys.platform) -> Any:
    """Return the driver's library.

    Raises:
        OSError: there is none.
    """
    name = "nvcuda.dll" if platform == "win32" else "libcuda.so.1"
    return (ctypes.WinDLL if platform == "win32" else ctypes.CDLL)(name)  # type: ignore[attr-defined]


class CudaDriver:
    """One GPU.

    Args:
        device: torch's.
        library: for tests; the driver's own without it.

    Attributes:
        architecture: of the GPU, as 86.
        multiprocessors: how many it has.
    """

    def __init__(self, device: torch.device, library: Optional[Any] = None) -> None:
        self._library = load_library() if library is None else library
        torch.empty(1, device=device)  # torch makes the context before it is asked for
        index = torch.cuda.current_device() if device.index is None else device.index
        self._device = torch.device("cuda", index)
        properties = torch.cuda.get_device_properties(index)
        self.architecture: int = 10 * properties.major + properties.minor
        self.multiprocessors: int = properties.multi_processor_count
        self._context = ctypes.c_void_p()
        # torch numbers the devices that CUDA_VISIBLE_DEVICES leaves, and so does the driver.
        self._call("cuDevicePrimaryCtxRetain", ctypes.byref(self._context), ctypes.c_int(index))

    def load(self, binary: bytes) -> ctypes.c_void_p:
        """Return a module of machine code or PTX."""
        module = ctypes.c_void_p()
        with self._current():
            self._call("cuModuleLoadData", ctypes.byref(module), binary)
        return module

    def function(self, module: ctypes.c_void_p, name: str) -> ctypes.c_void_p:
        """Return a kernel of a module."""
        function = ctypes.c_void_p()
        with self._current():
            self._call("cuModuleGetFunction", ctypes.byref(function), module, name.encode())
        return function

    def launch(self, function: ctypes.c_void_p, blocks: int, threads: int, task: ctypes.Structure) -> None:
        """Launch a kernel on torch's current stream; its one argument is copied at once."""
        stream = ctypes.c_void_p(torch.cuda.current_stream(self._device).cuda_stream)
        arguments = (ctypes.c_void_p * 1)(ctypes.addressof(task))
        sizes = [ctypes.c_uint(size) for size in (blocks, 1, 1, threads, 1, 1, 0)]
        with self._current():
            self._call("cuLaunchKernel", function, *sizes, stream, arguments, None)

    def capturing(self) -> bool:
        """Return whether the current stream is being captured: nothing may be loaded then."""
        return bool(torch.cuda.is_current_stream_capturing())

    @contextmanager
    def _current(self) -> Iterator[None]:
        # A thread of autograd's, or another device's, may have no context or another one.
        before = ctypes.c_void_p()
        self._call("cuCtxGetCurrent", ctypes.byref(before))
        if before.value == self._context.value:
            yield
            return
        self._call("cuCtxSetCurrent", self._context)
        try:
            yield
        finally:
            self._call("cuCtxSetCurrent", before)

    def _call(self, name: str, *arguments: Any) -> None:
        code = getattr(self._library, name)(*arguments)
        if code != 0:
            text = ctypes.c_char_p()
            self._library.cuGetErrorString(code, ctypes.byref(text))
            raise DriverError(f"{name} failed: {(text.value or b'unknown error').decode()} ({code})")
