"""Get a kernel by its name and variant: from memory, from the disk, or compiled."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, Dict, List, Mapping, NamedTuple, Optional

from legs_loss.errors import LegsError
from legs_loss.kernels import codes
from legs_loss.kernels.contract import NotNow
from legs_loss.kernels.cuda.driver import UNSUPPORTED_PTX, DriverError
from legs_loss.spec import WeightSpec
from legs_loss.system.files import write_whole

_WORDS = {"x": "x", "sqrt": "root", "unit": "saturated", "sin": "short_sine", "asin": "asinf"}
FORMULAS: Dict[str, str] = codes.formulas_in(_WORDS, "{}f".format)
_DIGEST = hashlib.sha256().digest_size
_OF_OTHERS = 0o022  # may be written by the group, or by all


class Variant(NamedTuple):
    """The settings that legs.cu is compiled with; one module has all kernels of a variant.

    Attributes:
        value: the images' type: 0 float32, 1 float16, 2 bfloat16.
        stencil: a kind of codes.py, of the response that weights come from; 0: they come from a map, or there are none.
        norm: of the response, a number of codes.py.
    """

    value: int
    stencil: int = 0
    norm: int = 0

    @property
    def kernels(self) -> List[str]:
        """Return the names of the kernels in its module."""
        terms = ["l1"] if self.stencil else ["l1", "loss", "ssim"]
        others = ["range", "range_finish"] if self.stencil else ["finish", "scale"]
        losses = [f"{term}_{kind}" for term in terms for kind in ("value", "gradient")]
        return [f"legs_{name}" for name in (*others, *losses)]


PLAIN = Variant(0)


def source() -> bytes:
    """Return the text of legs.cu, after the tables that it reads."""
    first = sorted(FORMULAS, key=lambda name: name != WeightSpec.curve)  # the default is found by one comparison
    curves = " ".join(f"CURVE({codes.CURVES[name]}, {FORMULAS[name]})" for name in first)
    curves = re.sub(r"/ ([\d.]+f)", r"* (1.0f / \1)", curves)  # a product is faster
    kinds = [f"#define {name} {getattr(codes, name)}" for name in ("FOUR", "EIGHT", "GRADIENT")]
    tables = "\n".join([*kinds, f"#define CURVES {curves}", '#line 1 "legs.cu"\n'])
    return tables.encode() + (Path(__file__).parent / "legs.cu").read_bytes()


def options(variant: Variant) -> List[str]:
    """Return the compiler's options for a variant."""
    value, stencil, norm = variant
    return ["--std=c++14", "--fmad=false", f"-DVALUE={value}", f"-DSTENCIL={stencil}", f"-DNORM={norm}"]


class Modules:
    """The kernels of one GPU.

    Args:
        driver: a :class:`~legs_loss.kernels.cuda.driver.CudaDriver`.
        compiler: a :class:`~legs_loss.kernels.cuda.nvrtc.Compiler`.
        cache: of compiled modules.
    """

    def __init__(self, driver: Any, compiler: Any, cache: BinaryCache) -> None:
        self.driver = driver
        self._compiler = compiler
        self._cache = cache
        self._functions: Dict[Variant, Dict[str, Any]] = {}
        self._lock = threading.Lock()

    def load(self, *variants: Variant) -> None:
        """Load all kernels of variants that are not loaded yet, so that no later call has to.

        Raises:
            NotNow: a capture, which loading would break, is under way; or the card is full.
            CompilerError, DriverError: one cannot be compiled or loaded.
        """
        for variant in variants:
            if variant in self._functions:
                continue
            if self.driver.capturing():
                raise NotNow
            with self._lock:
                if variant not in self._functions:
                    module = self._loaded(variant)
                    self._functions[variant] = {name: self.driver.function(module, name) for name in variant.kernels}

    def function(self, name: str, variant: Variant) -> Any:
        """Return a kernel for ``driver.launch``; raises as :meth:`load`."""
        self.load(variant)
        return self._functions[variant][name]

    def _loaded(self, variant: Variant) -> Any:
        text, given = source(), options(variant)
        target = self._compiler.target(self.driver.architecture)
        key = "\n".join([self._compiler.version, target, *given, hashlib.sha256(text).hexdigest()]).encode()
        binary = self._cache.get(key)
        if binary is not None:
            with suppress(DriverError):  # whatever it was compiled for: it is written over
                return self.driver.load(binary)
        binary, _ = self._compiler.compile(text, given, target)
        try:
            module = self.driver.load(binary)
        except DriverError as error:
            if error.code != UNSUPPORTED_PTX:
                raise
            raise DriverError(
                f"the GPU (sm_{self.driver.architecture}) is newer than torch's NVRTC {self._compiler.version}, "
                "and the driver too old for its PTX: update the driver, or install a torch for a newer CUDA",
                error.code,
            ) from None
        self._cache.put(key, binary)
        return module


def cache_folder(environment: Mapping[str, str] = os.environ, platform: str = sys.platform) -> Optional[Path]:
    """Return the folder of compiled kernels: in XDG_CACHE_HOME, LOCALAPPDATA (Windows) or ~/.cache; None if none is."""
    if platform == "win32" and environment.get("LOCALAPPDATA"):
        return Path(environment["LOCALAPPDATA"]) / "legs-loss" / "kernels"
    base = environment.get("XDG_CACHE_HOME", "")
    try:
        return (Path(base) if os.path.isabs(base) else Path.home() / ".cache") / "legs-loss" / "kernels"
    except RuntimeError:  # a container's user may have no home
        return None


class BinaryCache:
    """A folder of compiled kernels, each file with a checksum. Files that cannot be read or written are ignored.

    What lies in it runs on the card, so folder and files must be the user's own, and nobody else's to write.

    Args:
        folder: is made when something is kept; None keeps nothing.
    """

    def __init__(self, folder: Optional[Path]) -> None:
        self.folder = folder

    def get(self, key: bytes) -> Optional[bytes]:
        """Return what is kept under a key; None where there is nothing, or it is not what this user wrote."""
        if self.folder is None:
            return None
        try:
            with open(str(_path(self.folder, key)), "rb") as file:
                if not (_is_private(os.fstat(file.fileno())) and _is_private(os.stat(str(self.folder)))):
                    return None
                content = file.read()
        except OSError:
            return None
        digest, binary = content[:_DIGEST], content[_DIGEST:]
        return binary if binary and hashlib.sha256(key + binary).digest() == digest else None

    def put(self, key: bytes, binary: bytes) -> None:
        """Keep a binary: the file appears whole or not at all, whoever else writes it meanwhile."""
        if self.folder is None:
            return
        with suppress(OSError, LegsError):
            self.folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if _is_private(os.stat(str(self.folder))):
                write_whole(_path(self.folder, key), hashlib.sha256(key + binary).digest() + binary, mode=0o600)


def _is_private(found: os.stat_result) -> bool:
    if not hasattr(os, "getuid"):  # Windows: LOCALAPPDATA is the user's own
        return True
    return found.st_uid == os.getuid() and not found.st_mode & _OF_OTHERS


def _path(folder: Path, key: bytes) -> Path:
    return folder / f"{hashlib.sha256(key).hexdigest()}.bin"
