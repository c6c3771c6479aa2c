"""The benchmark that compiles the CUDA kernels for real GPUs: its variants and its verdict; and NVRTC, where it is."""

from __future__ import annotations

import sys
from typing import Any, Tuple

import pytest

from benchmarks import cuda_compile

LOG = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'legs_scale' for 'sm_86'
ptxas info    : Function properties for legs_scale
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 28 registers, used 0 barriers, 672 bytes cmem[0]
ptxas info    : Compiling entry function 'legs_loss_gradient' for 'sm_86'
ptxas info    : Function properties for legs_loss_gradient
    {stack} bytes stack frame, {stack} bytes spill stores, 8 bytes spill loads
ptxas info    : Used 128 registers, used 1 barriers, {shared} bytes smem, 672 bytes cmem[0]
"""


class FakeCompiler:
    version = "12.9"

    def __init__(self, log: str) -> None:
        self.log = log

    def target(self, architecture: int) -> str:
        return f"sm_{min(architecture, 90)}"

    def compile(self, source: bytes, options: Any, target: str) -> Tuple[bytes, str]:
        return b"", self.log


def run(monkeypatch: Any, compilers: Any, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["cuda_compile.py", *arguments])
    monkeypatch.setattr(cuda_compile, "found_compilers", lambda: compilers)
    return cuda_compile.main()


def test_every_variant_that_a_loss_can_ask_for() -> None:
    variants = cuda_compile.variants()
    assert len(variants) == len(set(variants)) == 3 * (1 + 3 * 3)


@pytest.mark.parametrize(("stack", "shared", "status"), [(0, 15104, 1), (16, 15104, 1), (0, 49153, 1)])
def test_a_spill_a_stack_or_too_much_shared_memory_is_a_failure(monkeypatch, capsys, stack, shared, status) -> None:
    compiler = FakeCompiler(LOG.format(stack=stack, shared=shared))
    assert run(monkeypatch, [compiler], "--architectures", "86", "120", "--only", "0,0,0") == status
    printed = capsys.readouterr().out
    assert "NVRTC 12.9 does not know sm_120" in printed
    assert f"registers 128  stack {stack}  spills {stack + 8}  shared {shared}" in printed
    assert "2 kernels of 1 variants, 1 with a spill" in printed


def test_kernels_without_any_are_a_success(monkeypatch) -> None:
    log = LOG.format(stack=0, shared=15104).replace("8 bytes spill loads", "0 bytes spill loads")
    assert run(monkeypatch, [FakeCompiler(log)], "--architectures", "86", "--only", "0,0,0") == 0


def test_without_a_compiler_it_says_what_to_install(monkeypatch, capsys) -> None:
    assert run(monkeypatch, []) == 2
    assert "pip install nvidia-cuda-nvrtc-cu12" in capsys.readouterr().err


@pytest.mark.slow
def test_with_the_nvrtc_that_is_installed(monkeypatch) -> None:
    compilers = cuda_compile.found_compilers()
    if not compilers:
        pytest.skip("needs nvidia-cuda-nvrtc-cu12 or nvidia-cuda-nvrtc")
    assert run(monkeypatch, compilers, "--architectures", "75", "90", "--only", "0,0,0", "2,1,2") == 0
