"""Where a run's settings come from, and which win."""

from __future__ import annotations

import pytest

from legs_loss import PRESETS, LegsError
from legs_loss.config import find_config


def find(start=None, argv=(), **environ):
    return find_config(start, environ, ["train.py", *argv])


def test_the_defaults_are_the_preset_legs():
    config = find()
    assert (config.spec, config.preset, config.store, config.active) == (PRESETS["legs"], "legs", None, True)


def test_a_file_above_the_script_is_found_up_to_the_checkouts_root(tmp_path):
    repo = tmp_path / "repo"
    (repo / "tools").mkdir(parents=True)
    (repo / ".git").mkdir()
    (tmp_path / "legs.toml").write_text("beta = 3")
    script = repo / "tools" / "train.py"
    script.write_text("")
    assert find(script).spec.beta == 10.0  # what lies outside the checkout is not its own
    (repo / "legs.toml").write_text('preset = "legs-l"\nbeta = 4\nstore = "maps"\n')
    config = find(script)
    assert (config.spec.curve, config.spec.beta, config.preset) == ("C1", 4.0, "legs-l")
    assert config.store == repo / "maps"
    assert config.source == str(repo / "legs.toml")


def test_the_environment_wins_over_the_file(tmp_path):
    (tmp_path / "legs.toml").write_text('preset = "legs-l"\nbeta = 4\n')
    config = find(tmp_path, LEGS_BETA="7", LEGS_CURVE="C5", LEGS_OPERATOR="scharr", LEGS_P="inf", LEGS_NORMALISE="mean")
    spec = config.spec
    assert (spec.beta, spec.curve, spec.operator, spec.normalise) == (7.0, "C5", "scharr", "mean")
    assert spec.p == float("inf")
    # A preset replaces the file's settings, not only their names.
    assert find(tmp_path, LEGS_PRESET="eggs").spec == PRESETS["eggs"]


@pytest.mark.parametrize(("value", "off"), [("1", True), ("true", True), ("0", False), ("", False)])
def test_legs_off(value, off):
    config = find(LEGS_OFF=value)
    assert config.off is off
    assert config.active is not off


def test_beta_zero_is_not_active():
    assert not find(LEGS_BETA="0").active


@pytest.mark.parametrize("form", [["-s", "{}"], ["--source_path", "{}"], ["--source_path={}"], ["-s={}"]])
def test_the_store_of_the_scripts_scene_is_found(tmp_path, form):
    argv = [part.format(tmp_path) for part in form]
    assert find(argv=argv).store is None
    (tmp_path / "legs_weights").mkdir()
    assert find(argv=argv).store == tmp_path / "legs_weights"
    assert find(argv=argv, LEGS_STORE=str(tmp_path / "other")).store == tmp_path / "other"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("beta = -1", "legs.toml: beta must be at least 0"),
        ('beta = "many"', "legs.toml: beta must be a number, got 'many'"),
        ('curve = "C9"', "legs.toml: no curve is named 'C9'"),
        ('prest = "legs"', "legs.toml: unknown setting 'prest'; there are preset, store, operator"),
        ("beta = ", "legs.toml cannot be read"),
    ],
)
def test_a_bad_file_is_named(tmp_path, text, message):
    (tmp_path / "legs.toml").write_text(text)
    with pytest.raises(LegsError, match=message):
        find(tmp_path)


def test_a_bad_variable_is_named():
    with pytest.raises(LegsError, match=r"LEGS_\*: no preset is named 'best'"):
        find(LEGS_PRESET="best")
