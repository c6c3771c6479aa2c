"""CUDA modules of other people, built from their sources with the nvcc that is there, in copies."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import List

import torch

from benchmarks.gpu.imports import need
from benchmarks.gpu.options import Options, Record, Skipped
from examples.reproduce_paper.codebases.training import copy_checkout

__all__ = ["copied", "fastgs_modules", "fused_ssim", "mend"]

# Functors that CUDA 13's cub no longer has, and what to write in their place.
GONE = {"cub::Max()": "cuda::maximum<>()", "cub::Min()": "cuda::minimum<>()"}
HEADER = "#include <cuda/functional>\n"
USUAL_HOME = Path("/usr/local/cuda")


def fused_ssim(options: Options, record: Record) -> None:
    """Build fused-ssim where it is not installed: from the checkout given, else from FastGS's submodule."""
    _need_cuda()
    if importlib.util.find_spec("fused_ssim") is not None:
        record(built="no: it is installed")
        return
    inside = Path(options.fastgs) / "submodules" / "fused-ssim" if options.fastgs else None
    source = Path(options.fused_ssim) if options.fused_ssim else inside
    if source is None or not (source / "setup.py").is_file():
        raise Skipped(f"there are no sources: give --fused-ssim CHECKOUT ({source} has no setup.py)")
    copy = Path(options.work) / "fused-ssim"
    if not copy.exists():
        shutil.copytree(str(source), str(copy), ignore=shutil.ignore_patterns(".git"))
    _build(copy, options.site)
    record(built="with nvcc")


def fastgs_modules(options: Options, record: Record) -> None:
    """Build the CUDA modules in a copy of FastGS; without a torch for CUDA, compile the files that need no torch."""
    copy = copied(options)
    modules = sorted(path.parent for path in (copy / "submodules").glob("*/setup.py"))
    if not modules:
        raise Skipped(f"{options.fastgs} has no submodules/*/setup.py: fetch it with --recursive")
    record(mended=[str(path.relative_to(copy)) for path in mend(copy / "submodules")])
    if torch.version.cuda is None:
        compiled = [str(path.relative_to(copy)) for module in modules for path in _compile_without_torch(module)]
        record(compiled=compiled)
        raise Skipped(f"the modules need a torch with CUDA; {len(compiled)} sources that need none were compiled")
    packages = {path.name for module in modules for path in module.iterdir() if path.is_dir()}
    need([copy / "train.py", copy / "render.py"], packages)
    built = []
    for module in modules:
        if not any((options.site / path.name).is_dir() for path in module.iterdir() if path.is_dir()):
            _build(module, options.site)  # fused-ssim may have been built before
        built.append(module.name)
        record(built=built)


def copied(options: Options) -> Path:
    """Return the copy of the FastGS checkout that is built and trained in.

    Raises:
        Skipped: no checkout was given.
    """
    if options.fastgs is None:
        raise Skipped("no --fastgs CHECKOUT was given")
    copy = Path(options.work) / "FastGS"
    if not copy.is_dir():
        copy_checkout(Path(options.fastgs), copy)
    return copy


def mend(folder: Path) -> List[Path]:
    """Write CUDA 13's functors in the place of those that are gone from cub; return the files that were changed."""
    changed = []
    for path in sorted(folder.rglob("*.cu")):
        text = mended = path.read_text(encoding="utf-8", errors="surrogateescape")
        for old, new in GONE.items():
            mended = mended.replace(old, new)
        if mended != text:
            path.write_text(HEADER + mended, encoding="utf-8", errors="surrogateescape")
            changed.append(path)
    return changed


def _build(source: Path, site: Path) -> None:
    """Install a package into a folder, its extension compiled by the setup.py that it comes with."""
    command = [sys.executable, "-m", "pip", "install", "--no-build-isolation", "--no-deps", "--no-index", "--upgrade"]
    environment = dict(os.environ, MAX_JOBS=os.environ.get("MAX_JOBS", str(os.cpu_count() or 1)))
    if not torch.cuda.is_available():
        environment.setdefault("TORCH_CUDA_ARCH_LIST", "9.0")
    if USUAL_HOME.is_dir():  # torch guesses it from nvcc, which may be a script elsewhere
        environment.setdefault("CUDA_HOME", str(USUAL_HOME))
    done = subprocess.run(
        [*command, "--target", str(site), str(source)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )
    if done.returncode != 0:
        print(done.stdout[-6000:], flush=True)
        raise RuntimeError(f"{source.name} does not build: {_why(done.stdout)}")


def _compile_without_torch(module: Path) -> List[Path]:
    """Compile the sources of a module that do not include torch's headers; return them."""
    nvcc = shutil.which("nvcc")
    if nvcc is None:
        raise Skipped("the modules need a torch with CUDA, and there is no nvcc")
    compiled = []
    includes = [f"-I{path.parent}" for path in module.glob("third_party/*/*") if path.name == "glm"]
    for path in sorted(module.rglob("*.cu")):
        command = [nvcc, "-c", "-arch=sm_90", "-w", *includes, str(path), "-o", str(path.with_suffix(".o"))]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        said = _why(done.stdout + done.stderr)
        if done.returncode == 0:
            compiled.append(path)
        elif "torch" not in said:  # else it includes torch's headers, by itself or by its own
            raise RuntimeError(f"{path.name} does not compile: {said}")
    return compiled


def _why(output: str) -> str:
    """Return the first line that a compiler or linker calls an error, else the last line."""
    lines = output.strip().splitlines() or ["no message"]
    return next((line.strip() for line in lines if "error:" in line or "cannot find" in line), lines[-1])[:300]


def _need_cuda() -> None:
    if torch.version.cuda is None:
        raise Skipped("needs a torch with CUDA")
