"""Presets, and settings that are refused."""

from __future__ import annotations

import pytest

from legs_loss import PRESETS, LegsError, WeightSpec
from legs_loss.spec import as_spec


def test_presets_are_the_designs():
    assert PRESETS["3dgs"].beta == 0.0
    assert (PRESETS["eggs"].operator, PRESETS["eggs"].curve) == ("sobel", "C1")
    assert (PRESETS["legs-l"].operator, PRESETS["legs-l"].curve) == ("laplacian", "C1")
    assert (PRESETS["legs"].operator, PRESETS["legs"].curve) == ("laplacian", "C3")
    assert all(spec.p == 2.0 and spec.normalise == "none" for spec in PRESETS.values())
    assert all(PRESETS[name].beta == 10.0 for name in ("eggs", "legs-l", "legs"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"beta": -1.0}, "beta must be at least 0 and at most 1e6, got -1.0"),
        ({"beta": float("nan")}, "beta"),
        ({"beta": float("inf")}, "beta"),
        ({"beta": "3"}, "beta must be a number, got '3'"),
        ({"beta": None}, "beta"),
        ({"operator": ["sobel"]}, "no operator is named"),
        ({"percentile": 0.0}, "percentile"),
        ({"percentile": 101.0}, "percentile"),
        ({"eps": 0.0}, "eps"),
        ({"normalise": "max"}, '"none" or "mean"'),
        ({"operator": "canny"}, "operator"),
        ({"p": 0.5}, "1, 2 or inf"),
        ({"curve": "c3"}, "no curve is named 'c3'"),
    ],
)
def test_a_setting_out_of_range_is_named(settings, message):
    with pytest.raises(LegsError, match=message):
        WeightSpec(**settings)


@pytest.mark.parametrize("name", ["LEGS", None, 3])
def test_an_unknown_preset_lists_what_there_is(name):
    with pytest.raises(LegsError, match="3dgs, eggs, legs-l, legs"):
        as_spec(name)


def test_presets_cannot_be_changed():
    with pytest.raises(TypeError):
        PRESETS["legs"] = WeightSpec()
