"""The count of instructions, on a kernel that is counted by hand, and on the real ones where the tools are there."""

from __future__ import annotations

import doctest
from typing import Any

import pytest

from benchmarks import cuda_compile, cuda_instructions

# A loop with a short way that only loads, and two that store: one with the slow path of a division, one by a jump.
SASS = """
.text.other:
        /*0000*/                   EXIT ;
\t.section\t.text.kernel
.text.kernel:
        /*0000*/                   MOV R1, c[0x0][0x28] ;
.L_x_1:
        /*0010*/                   LDG.E R0, [R2] ;
        /*0020*/               @P3 BRA `(.L_x_1) ;
        /*0030*/                   BAR.SYNC.DEFER_BLOCKING 0x0 ;
        /*0040*/                   MUFU.SQRT R4, R0 ;
        /*0050*/               @P0 CALL.REL.NOINC `(.L_x_2) ;
        /*0060*/                   MOV R9, 0x70 ;
        /*0070*/                   FMUL R9, R9, R9 ;
        /*0080*/                   FADD R9, R9, R9 ;
        /*0090*/                   BRA `(.L_x_3) ;
.L_x_2:
        /*00a0*/                   FFMA R5, R4, R0, R5 ;
        /*00b0*/              @!P1 BRA `(.L_x_3) ;
        /*00c0*/                   CALL.REL.NOINC `($slow) ;
.L_x_3:
        /*00d0*/                   STG.E [R6], R5 ;
        /*00e0*/                   STS [R7], R5 ;
        /*00f0*/               @P2 BRA `(.L_x_1) ;
        /*0100*/                   EXIT ;
\t.section\t.text.last
"""


def test_the_shortest_way_that_does_a_steps_work_is_counted() -> None:
    instructions = cuda_instructions.read(SASS, "kernel")
    assert len(instructions) == 17 and cuda_instructions.loops_of(instructions) == [(1, 2), (1, 15)]
    assert instructions[5].target == 10 and instructions[12].target is None
    assert dict(cuda_instructions.shortest(instructions, 1, 15, cuda_instructions.Way(1, 1))) == {
        "global": 1 + 1,
        "barrier": 1,
        "special": 1,
        "control": 1 + 1 + 1 + 1,  # three branches and the jump
        "fp32": 1,
        "shared": 1,
    }
    light = cuda_instructions.shortest(instructions, 1, 15, cuda_instructions.Way(1, 0, 0))
    assert dict(light) == {"global": 1, "control": 1}


def test_a_way_that_is_not_there_is_an_error() -> None:
    instructions = cuda_instructions.read(SASS, "kernel")
    with pytest.raises(SystemExit, match="no way through the loop"):
        cuda_instructions.shortest(instructions, 1, 15, cuda_instructions.Way(2))


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
