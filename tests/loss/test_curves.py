"""The five curves by value, and the registry."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch

from legs_loss import LegsError, WeightSpec, register_curve, weight_map
from legs_loss.curves import FORMULAS, curve, curve_names

BY_HAND = {
    "C1": lambda x: x,
    "C2": lambda x: x**2,
    "C3": math.sqrt,
    "C4": lambda x: 3 * x**2 - 2 * x**3,
    "C5": lambda x: 0.5 - math.sin(math.asin(1 - 2 * x) / 3),
}


@pytest.mark.parametrize("name", sorted(BY_HAND))
def test_values(name):
    x = torch.linspace(0, 1, 101, dtype=torch.float64)
    expected = torch.tensor([BY_HAND[name](float(v)) for v in x], dtype=torch.float64)
    torch.testing.assert_close(curve(name)(x), expected)


@pytest.mark.parametrize("name", sorted(BY_HAND))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_unit_interval_is_kept_and_order_too(name, dtype):
    x = torch.linspace(0, 1, 4097, dtype=dtype)
    y = curve(name)(x)
    assert float(y[0]) == pytest.approx(0.0, abs=1e-7)
    assert float(y[-1]) == pytest.approx(1.0, abs=1e-7)
    assert float(y.min()) >= 0.0
    assert float(y.max()) <= 1.0
    assert bool((y[1:] >= y[:-1] - 1e-6).all())


def test_every_curve_has_its_values_by_hand():
    assert set(BY_HAND) == set(FORMULAS)


def test_the_formulas_of_the_documentation_are_those_of_the_table():
    page = (Path(__file__).parents[2] / "docs" / "method.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (C\d+) \| (.+?) \|", page, re.MULTILINE))
    assert list(rows) == list(FORMULAS)
    for name, text in rows.items():
        text = re.sub(r" \([^()x]+\)$", "", text)  # its name in words
        for sign, meant in (("√x", "sqrt(x)"), ("½", "0.5"), ("−", "-"), ("²", "**2"), ("³", "**3")):
            text = text.replace(sign, meant)
        text = re.sub(r"(\d)(x|sqrt)", r"\1*\2", text)
        for x in (0.0, 0.1, 0.5, 0.8, 1.0):
            expected = eval(text, {"sqrt": math.sqrt, "sin": math.sin, "asin": math.asin, "x": x})
            assert float(curve(name)(torch.tensor(x, dtype=torch.float64))) == pytest.approx(expected, abs=1e-12)


def test_c5_undoes_c4():
    x = torch.linspace(0, 1, 101, dtype=torch.float64)
    torch.testing.assert_close(curve("C4")(curve("C5")(x)), x)


def test_a_user_may_register_one():
    register_curve("test-step", lambda x: (x > 0.5).to(x.dtype))
    assert "test-step" in curve_names()
    image = torch.zeros(1, 5, 5)
    image[0, 2, 2] = 1.0
    weight = weight_map(image, WeightSpec(curve="test-step", beta=2.0))
    assert sorted(set(weight.flatten().tolist())) == [1.0, 3.0]


@pytest.mark.parametrize(
    ("name", "function", "message"),
    [
        ("C3", lambda x: x, "exists already"),
        ("", lambda x: x, "non-empty"),
        ("test-high", lambda x: 2 * x, "from 0 to 2"),
        ("test-nan", lambda x: x / 0 * 0, r"\[0, 1\]"),
        ("test-shape", lambda x: x.sum(), "shape"),
    ],
)
def test_what_is_no_curve_is_refused(name, function, message):
    with pytest.raises(LegsError, match=message):
        register_curve(name, function)
    assert name == "C3" or name not in curve_names()


def test_an_unknown_name_lists_what_there_is():
    with pytest.raises(LegsError, match="C1, C2, C3, C4, C5"):
        WeightSpec(curve="C0")
