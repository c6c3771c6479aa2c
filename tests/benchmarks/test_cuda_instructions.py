"""The count of instructions, on a kernel that is counted by hand, and on the real ones where the tools are there."""

from __future__ import annotations

import doctest
from typing import Any

import pytest

from benchmarks import cuda_compile, cuda_instructions

# A step of nine instructions; of these two write a row of two in a loop, and two are the slow path of a division.
SASS = """
.text.other:
        /*0000*/                   EXIT ;
\t.section\t.text.kernel
.text.kernel:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   LDG.E R0, [R2] ;
        /*0020*/                   BAR.SYNC.DEFER_BLOCKING 0x0 ;
        /*0030*/                   MUFU.RCP R4, R0 ;
        /*0040*/               @P0 BRA `(.L_x_2) ;
        /*0050*/                   MOV R9, 0x70 ;
        /*0060*/                   CALL.REL.NOINC `($slow) ;
.L_x_2:
        /*0070*/                   FFMA R5, R4, R0, R5 ;
        /*0080*/                   STG.E [R6], R5 ;
        /*0090*/                   FADD R5, R4, R0 ;
        /*00a0*/                   STG.E [R6+0x4], R5 ;
        /*00b0*/              @!P1 BRA `(.L_x_2) ;
        /*00c0*/                   IADD3 R7, R7, 0x4, RZ ;
        /*00d0*/               @P2 BRA `(.L_x_1) ;
        /*00e0*/                   EXIT ;
\t.section\t.text.last
"""


def test_a_step_is_counted_as_it_runs() -> None:
    instructions = cuda_instructions.read(SASS, "kernel")
    assert len(instructions) == 15 and instructions[-2].target == 1 and instructions[4].target == 7
    assert dict(cuda_instructions.executed(instructions)) == {
        "global": 1 + 2 * 2,  # a load, and a loop of two rounds that stores two values
        "barrier": 1,
        "special": 1,
        "control": 1 + 0 + 2 * 1 + 1,  # the branch around the slow path, no call, the loops' own
        "integer": 0 + 1,
        "fp32": 2 * 2,
    }


def test_its_example() -> None:
    found = doctest.testmod(cuda_instructions)
    assert found.attempted > 0 and found.failed == 0


@pytest.mark.slow
def test_the_kernels_keep_to_their_budget(capsys: Any) -> None:
    nvdisasm = cuda_instructions.disassembler()
    compilers = [each for each in cuda_compile.found_compilers() if each.version.startswith("12.")]
    if nvdisasm is None or not compilers:
        pytest.skip("needs nvidia-cuda-nvrtc-cu12 and nvidia-cuda-nvdisasm")
    table, above = cuda_instructions.report(compilers[0], 90, nvdisasm)
    assert not above and all(row["fp32"] > 200 for row in table.values())
