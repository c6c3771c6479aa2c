"""The number of Python calls of a steady step: a count, which no busy machine changes."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

import legs_loss
from legs_loss.kernels.available import BACKENDS
from tests.runtime.support import pair

MOST, OURS, FILES = 60, 22, 8


@pytest.mark.parametrize("loss", ["l1_loss", "legs_loss"])
def test_a_step_on_the_cpu_is_few_python_calls(loss):
    if BACKENDS.chosen(torch.device("cpu")) != "numba":
        pytest.skip("torch computes it here")
    image, target = pair(3, 24, 33)
    step = getattr(legs_loss, loss)
    for _ in range(3):
        step(image, target).backward()
    called = []
    sys.setprofile(lambda frame, event, _: called.append(frame.f_code.co_filename) if event == "call" else None)
    try:
        step(image, target).backward()
    finally:
        sys.setprofile(None)
    package = str(Path(legs_loss.__file__).parent)
    ours = [name for name in called if name.startswith(package)]
    assert 0 < len(ours) <= OURS and len(called) <= MOST and len(set(ours)) <= FILES
    assert torch.isfinite(image.grad).all()


def test_a_steady_step_sees_what_changed(monkeypatch):
    image, target = pair(3, 24, 33)
    expected = {}
    for beta in (10.0, 4.0):
        legs_loss.configure(legs_loss.WeightSpec(beta=beta))
        for _ in range(3):
            found = legs_loss.l1_loss(image, target)
        expected[beta] = (legs_loss.weight_map(target, legs_loss.WeightSpec(beta=beta)) * (image - target).abs()).mean()
        torch.testing.assert_close(found, expected[beta])
    assert not torch.isclose(expected[10.0], expected[4.0])
    monkeypatch.setenv("LEGS_BACKEND", "torch")
    torch.testing.assert_close(legs_loss.l1_loss(image, target), expected[4.0])
    target[0, 3, 3] = float("nan")
    with pytest.raises(legs_loss.LegsError, match="NaN"):
        legs_loss.l1_loss(image, target)
    with pytest.raises(legs_loss.LegsError, match="differ in shape"):
        legs_loss.l1_loss(image, target[:, :5])
