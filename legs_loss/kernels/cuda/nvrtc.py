"""The compiler: NVRTC, found among torch's own wheels, called through ctypes."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from pathlib import Path
from typing import Any, Iterable, Iterator, List, Optional, Sequence, Tuple

_BUILTINS = re.compile(r"(libnvrtc-builtins(-[0-9a-f]+)?\.so\.[0-9.]+|nvrtc-builtins64_[0-9]+\.dll)$")


class NotFound(Exception):
    """NVRTC was not found; the message says where it was searched."""


class CompilerError(Exception):
    """NVRTC refused; the message is its log's first error."""


def candidates(folders: Iterable[Path], major: str, platform: str = sys.platform) -> Iterator[Path]:
    """Yield the NVRTC libraries in folders, by name for a major version of CUDA.

    Args:
        folders: torch's ``lib`` folder, then those that hold packages named ``nvidia``.
        major: of CUDA, as "12".
        platform: as ``sys.platform``.
    """
    # CUDA 11 kept the number 11.2 (Windows: 112_0) in all of its versions.
    linux = rf"libnvrtc(-[0-9a-f]+)?\.so(\.{major}(\.[0-9.]+)?)?$"
    name = re.compile(rf"nvrtc64_{major}\d?_0\.dll$" if platform == "win32" else linux)
    for folder in folders:
        wheels = folder / "nvidia"
        nested = [folder] if folder.name == "lib" else sorted([*wheels.glob("*/*"), *wheels.glob("*/bin/x86_64")])
        for place in filter(Path.is_dir, nested):
            yield from (path for path in sorted(place.iterdir()) if name.match(path.name))


def _plain_name(major: str, platform: str = sys.platform) -> str:
    if platform == "win32":
        return f"nvrtc64_{'112' if major == '11' else major + '0'}_0.dll"
    return f"libnvrtc.so.{'11.2' if major == '11' else major}"


def find_compiler(folders: Optional[Sequence[Path]] = None, version: Optional[str] = None) -> Compiler:
    """Return the NVRTC of the CUDA that torch was built with; failing that the one that the system finds by name.

    Raises:
        NotFound: no library is there, or none of them loads; the message has the last one's reason.
    """
    import torch

    version = version or torch.version.cuda or ""
    major = version.split(".")[0]
    if folders is None:
        folders = [Path(torch.__file__).parent / "lib", *(Path(place) for place in sys.path if place)]
    plain = _plain_name(major)
    reason = "none lies beside torch or in a package named nvidia"
    for path in [*map(str, candidates(folders, major)), plain]:
        try:
            return Compiler(_loaded(path))
        except (OSError, CompilerError) as error:
            reason = str(error).splitlines()[0]
    raise NotFound(f"no NVRTC of CUDA {version} was found: {reason}")


def _loaded(path: str) -> Any:
    folder = os.path.dirname(path)
    if folder:
        # NVRTC asks for its builtins by name alone, which the system need not find.
        for name in sorted(os.listdir(folder)):
            if _BUILTINS.match(name):
                ctypes.CDLL(os.path.join(folder, name))
    return ctypes.CDLL(path)


class Compiler:
    """NVRTC.

    Args:
        library: as ``ctypes.CDLL`` returns it.
    """

    def __init__(self, library: Any) -> None:
        self._library = library
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._call("Version", ctypes.byref(major), ctypes.byref(minor))
        self.version: str = f"{major.value}.{minor.value}"

    def target(self, architecture: int) -> str:
        """Return what to compile for on a GPU, as "sm_86"; "compute_86" (PTX) where the GPU is newer than NVRTC."""
        known = self._architectures()
        if architecture in known:
            return f"sm_{architecture}"
        older = [number for number in known if number < architecture]
        if not older:
            raise CompilerError(f"NVRTC {self.version} does not compile for sm_{architecture}")
        return f"compute_{max(older)}"

    def compile(self, source: bytes, options: Sequence[str], target: str) -> Tuple[bytes, str]:
        """Compile a source: machine code for ``cuModuleLoadData``, or PTX for a GPU that is newer; and the log.

        Raises:
            CompilerError: it does not compile.
        """
        library, program = self._library, ctypes.c_void_p()
        self._call("CreateProgram", ctypes.byref(program), source, b"legs.cu", 0, None, None)
        try:
            given = [option.encode() for option in (f"--gpu-architecture={target}", *options)]
            code = library.nvrtcCompileProgram(program, len(given), (ctypes.c_char_p * len(given))(*given))
            log = self._text(program, "ProgramLog").rstrip(b"\0").decode("utf-8", "replace")
            if code != 0:
                errors = [line for line in log.splitlines() if "error" in line]
                raise CompilerError(errors[0] if errors else self._message(code))
            return self._text(program, "CUBIN" if target.startswith("sm_") else "PTX"), log
        finally:
            library.nvrtcDestroyProgram(ctypes.byref(program))

    def _text(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._call(f"Get{what}Size", program, ctypes.byref(size))
        text = ctypes.create_string_buffer(size.value)
        self._call(f"Get{what}", program, text)
        return text.raw

    def _architectures(self) -> List[int]:
        count = ctypes.c_int()
        self._call("GetNumSupportedArchs", ctypes.byref(count))
        numbers = (ctypes.c_int * count.value)()
        self._call("GetSupportedArchs", numbers)
        return list(numbers)

    def _call(self, function: str, *arguments: Any) -> None:
        code = getattr(self._library, f"nvrtc{function}")(*arguments)
        if code != 0:
            raise CompilerError(f"nvrtc{function} failed: {self._message(code)}")

    def _message(self, code: int) -> str:
        self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        return (self._library.nvrtcGetErrorString(code) or b"unknown error").decode()
