"""Find library functions that fuse L1 and SSIM, ``fused_l1_ssim_loss(image, gt)``: they are split by hand."""

from __future__ import annotations

from typing import Iterator, Tuple

import libcst as cst

from legs_adapters.code.module import Function
from legs_adapters.code.parsing import Place
from legs_adapters.code.program import Program
from legs_adapters.code.syntax import call_name, one_line
from legs_adapters.tensors.backward import Training
from legs_adapters.terms.findings import Problem

__all__ = ["fused_losses"]


def fused_losses(program: Program, training: Training, function: Function) -> Iterator[Tuple[Place, Problem]]:
    """Yield the calls of fused losses that a function trains on, as problems, each with its place."""
    for call in function.flow.calls:
        if not _is_fused(call) or not training.includes(call):
            continue
        if all(reference.kind == "external" for reference in program.resolve(function, call.func)):
            place = function.place(call)
            sides = ", ".join(one_line(arg.value) for arg in call.args[:2])
            advice = f"(1 - w) * legs_loss.l1_loss({sides}) + w * legs_loss.d_ssim({sides})"
            why = "one function computes L1 and SSIM: split it, with w the weight of SSIM"
            yield place, Problem.at(function, place, why, advice)


def _is_fused(call: cst.Call) -> bool:
    name = call_name(call).lower()
    return "l1" in name and "ssim" in name and len(call.args) >= 2
