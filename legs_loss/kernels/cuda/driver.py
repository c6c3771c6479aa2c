"""Load and launch kernels: the CUDA driver's functions, called through ctypes, in torch's context."""

from __future__ import annotations

import ctypes
import sys
from contextlib import contextmanager
from typing import Any, Dict, Iterator, List, Optional, Tuple

import torch

from legs_loss.kernels.contract import DeviceFault, NotNow

UNSUPPORTED_PTX = 222
_OUT_OF_MEMORY = 2
# What a kernel did that ran before: from then on every call returns it, until the process ends.
_STICKY = frozenset({700, 702, 710, 714, 715, 716, 717, 718, 719})
_RELAXED = 2  # a mode of stream capture

_POINTER, _INT, _UNSIGNED = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint
_OUT = ctypes.POINTER(ctypes.c_void_p)
_One = _POINTER * 1
_ARGUMENTS: Dict[str, List[Any]] = {
    "cuDevicePrimaryCtxRetain": [_OUT, _INT],
    "cuCtxGetCurrent": [_OUT],
    "cuCtxSetCurrent": [_POINTER],
    "cuThreadExchangeStreamCaptureMode": [ctypes.POINTER(_INT)],
    "cuModuleLoadData": [_OUT, ctypes.c_char_p],
    "cuModuleGetFunction": [_OUT, _POINTER, ctypes.c_char_p],
    "cuLaunchKernel": [_POINTER, *[_UNSIGNED] * 7, _POINTER, ctypes.POINTER(_POINTER), _POINTER],
    "cuGetErrorString": [_INT, ctypes.POINTER(ctypes.c_char_p)],
}


class DriverError(Exception):
    """The CUDA driver returned an error; the message names the function and the reason.

    Attributes:
        code: the driver's.
    """

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


class OutOfMemory(NotNow):
    """The card is full: torch computes this call, and the next one tries again."""


class CudaDriver:
    """One GPU.

    Args:
        device: torch's.
        library: for tests; the driver's own without it.
        runtime: for tests; torch.cuda without it.

    Attributes:
        architecture: of the GPU, as 86.
        multiprocessors: how many it has.
    """

    def __init__(self, device: torch.device, library: Optional[Any] = None, runtime: Any = torch.cuda) -> None:
        if library is None:
            is_windows = sys.platform == "win32"
            library = ctypes.WinDLL("nvcuda.dll") if is_windows else ctypes.CDLL("libcuda.so.1")  # type: ignore[attr-defined]
        for name, arguments in _ARGUMENTS.items():
            getattr(library, name).argtypes = arguments
        self._library, self._runtime, self._launch_kernel = library, runtime, library.cuLaunchKernel
        torch.empty(1, device=device)  # torch makes the context before it is asked for
        self._index = index = runtime.current_device() if device.index is None else device.index
        properties = runtime.get_device_properties(index)
        self.architecture: int = 10 * properties.major + properties.minor
        self.multiprocessors: int = properties.multi_processor_count
        # torch numbers the devices that CUDA_VISIBLE_DEVICES leaves, and so does the driver.
        self._context = self._made("cuDevicePrimaryCtxRetain", index)
        raw = getattr(torch._C, "_cuda_getCurrentRawStream", None)  # some microseconds faster
        usual = runtime is not torch.cuda or raw is None
        self._stream: Any = (lambda index: runtime.current_stream(index).cuda_stream) if usual else raw

    def load(self, binary: bytes) -> int:
        """Return a module of machine code or PTX. Where the card is full, torch's cache is emptied first.

        Raises:
            OutOfMemory: there is no room for it.
            DriverError: it cannot be loaded.
        """
        with self._current():
            try:
                return self._made("cuModuleLoadData", binary)
            except OutOfMemory:
                self._runtime.empty_cache()
                return self._made("cuModuleLoadData", binary)

    def function(self, module: int, name: str) -> int:
        """Return a kernel of a module."""
        with self._current():
            return self._made("cuModuleGetFunction", module, name.encode())

    def launch(self, task: ctypes.Structure, *kernels: Tuple[int, int, int]) -> None:
        """Launch kernels, each with its blocks and threads, in this order on torch's current stream.

        Their one argument is copied at once.
        """
        now = _POINTER()
        code = self._library.cuCtxGetCurrent(ctypes.byref(now))
        if code:
            self._fail("cuCtxGetCurrent", code)
        if now.value != self._context:  # seldom; a generator takes some microseconds
            with self._current():
                return CudaDriver.launch(self, task, *kernels)
        arguments, stream = _One(ctypes.addressof(task)), self._stream(self._index)
        for function, blocks, threads in kernels:
            code = self._launch_kernel(function, blocks, 1, 1, threads, 1, 1, 0, stream, arguments, None)
            if code:
                self._fail("cuLaunchKernel", code)

    def capturing(self) -> bool:
        """Return whether the current stream is being captured: nothing is loaded then."""
        return bool(self._runtime.is_current_stream_capturing())

    @contextmanager
    def _current(self) -> Iterator[None]:
        """Make torch's context the current one of a thread, which may have none or another device's.

        What is loaded meanwhile does not end the capture of another thread's stream.
        """
        before, mode = ctypes.c_void_p(), ctypes.c_int(_RELAXED)
        self._call("cuCtxGetCurrent", ctypes.byref(before))
        self._call("cuThreadExchangeStreamCaptureMode", ctypes.byref(mode))
        try:
            self._call("cuCtxSetCurrent", self._context)
            yield
        finally:
            self._call("cuCtxSetCurrent", before)
            self._call("cuThreadExchangeStreamCaptureMode", ctypes.byref(mode))

    def _made(self, name: str, *arguments: Any) -> Any:
        """Return what a function of the driver writes to its first argument."""
        made = ctypes.c_void_p()
        self._call(name, ctypes.byref(made), *arguments)
        return made.value

    def _call(self, name: str, *arguments: Any) -> None:
        code = getattr(self._library, name)(*arguments)
        if code:
            self._fail(name, code)

    def _fail(self, name: str, code: int) -> None:
        text = ctypes.c_char_p()
        self._library.cuGetErrorString(code, ctypes.byref(text))
        reason = f"{(text.value or b'unknown error').decode()} ({code})"
        if code == _OUT_OF_MEMORY:
            raise OutOfMemory(f"{name} failed: {reason}")
        if code in _STICKY:
            raise DeviceFault(
                f"CUDA error: {reason}, of a kernel that was launched before; CUDA_LAUNCH_BLOCKING=1 shows which"
            )
        raise DriverError(f"{name} failed: {reason}", code)
