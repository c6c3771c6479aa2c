"""Get a kernel by its name and variant: from memory, from the disk cache, or compiled."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from typing import Any, Dict, List, NamedTuple, Tuple

from legs_loss.kernels.contract import NotNow
from legs_loss.kernels.cuda.cache import BinaryCache

__all__ = ["PLAIN", "Modules", "Variant", "options", "source"]


class Variant(NamedTuple):
    """The settings that legs.cu is compiled with; one module has all kernels of a variant.

    Attributes:
        value: the images' type: 0 float32, 1 float16, 2 bfloat16.
        stencil: 0: weights from a map, or none; 1 to 3: from the response to a stencil of that kind.
        norm: of the response: 1, 2, 3 for infinity.
    """

    value: int
    stencil: int = 0
    norm: int = 0


PLAIN = Variant(0)


def source() -> bytes:
    """Return the text of legs.cu."""
    return (Path(__file__).parent / "legs.cu").read_bytes()


def options(variant: Variant) -> List[str]:
    """Return the compiler's options for a variant."""
    value, stencil, norm = variant
    return ["--std=c++14", "--fmad=false", f"-DVALUE={value}", f"-DSTENCIL={stencil}", f"-DNORM={norm}"]


class Modules:
    """The kernels of one GPU.

    Args:
        driver: loads and launches; :class:`~legs_loss.kernels.cuda.driver.CudaDriver` says how it looks.
        compiler: as :class:`~legs_loss.kernels.cuda.nvrtc.Compiler`.
        cache: of compiled modules.
    """

    def __init__(self, driver: Any, compiler: Any, cache: BinaryCache) -> None:
        self.driver = driver
        self._compiler = compiler
        self._cache = cache
        self._modules: Dict[Variant, Any] = {}
        self._functions: Dict[Tuple[str, Variant], Any] = {}
        self._lock = threading.Lock()

    def function(self, name: str, variant: Variant) -> Any:
        """Return a kernel for ``driver.launch``.

        Raises:
            NotNow: it is not loaded, and a capture, which loading would break, is under way.
            CompilerError, DriverError: it cannot be compiled or loaded.
        """
        key = (name, variant)
        if key not in self._functions:
            if self.driver.capturing():
                raise NotNow
            with self._lock:
                if variant not in self._modules:
                    self._modules[variant] = self.driver.load(self._binary(variant))
                self._functions[key] = self.driver.function(self._modules[variant], name)
        return self._functions[key]

    def _binary(self, variant: Variant) -> bytes:
        text, given = source(), options(variant)
        target = self._compiler.target(self.driver.architecture)
        key = "\n".join([self._compiler.version, target, *given, hashlib.sha256(text).hexdigest()]).encode()
        binary = self._cache.get(key)
        if binary is None:
            binary = self._compiler.compile(text, given, target).binary
            self._cache.put(key, binary)
        return binary
