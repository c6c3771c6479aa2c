"""The axis of an image's channels, by each sign in the code around it."""

from __future__ import annotations

import pytest

pytest.importorskip("libcst")

from legs_adapters.tensors.backward import Training
from legs_adapters.tensors.layout import is_channels_last

from tests.code.support import call, function, program

CASES = {
    "nothing said": ("image, gt = f(), g()", False),
    "gsplat's rasterization": ("image, _, _ = rasterization(a)\ngt = g()", True),
    "permuted to last": ("image = render(a).permute(1, 2, 0)\ngt = g()", True),
    "permuted to first": ("image = render(a).permute(2, 0, 1)\ngt = g()", False),
    "there and back": ("image = rasterization(a)[0].permute(0, 3, 1, 2)\ngt = g()", False),
    "einops to last": ("image = rearrange(render(a), 'c h w -> h w c')\ngt = g()", True),
    "einops to first": ("image = rearrange(render(a), 'h w c -> c h w')\ngt = g()", False),
    "moved to the device after": ("image = rasterization(a)[0].clamp(0, 1).cuda()\ngt = g()", True),
    "the target says it": ("image = f()\ngt = load(a).permute(1, 2, 0).to('cuda')", True),
    "three channels of the last axis": ("image = f()[..., :3]\ngt = g()[..., :3]", True),
    "three channels of the first axis": ("image = f()[:3]\ngt = g()[:3]", False),
}


@pytest.mark.parametrize("name", CASES)
def test_each_sign(name):
    lines = "".join(f"    {line}\n" for line in CASES[name][0].splitlines())
    made = program(f"def step(a):\n{lines}    loss = l1(image, gt)\n    loss.backward()\n")
    where = function(made, "step")
    images = [argument.value for argument in call(where, "l1(image, gt)").args]
    assert is_channels_last(Training(made, lambda text: True), where, *images) is CASES[name][1]


def test_a_caller_s_image_says_it_for_a_function_s_parameter():
    made = program(
        "def loss(image, gt):\n    return l1(image, gt)\n\n"
        "def step(a):\n    loss(rasterization(a)[0], load(a)).backward()\n"
    )
    where = function(made, "loss")
    images = [argument.value for argument in call(where, "l1(image, gt)").args]
    assert is_channels_last(Training(made, lambda text: True), where, *images)
