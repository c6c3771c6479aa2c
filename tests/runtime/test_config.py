"""The sources of a run's settings, and their order."""

from __future__ import annotations

import os

import pytest

from legs_loss import PRESETS, LegsError
from legs_loss.config import find_config


def find(start=None, argv=(), **environ):
    return find_config(start, environ, ["train.py", *argv])


def test_the_defaults_are_the_preset_legs():
    config = find()
    assert (config.spec, config.preset, config.store, config.off) == (PRESETS["legs"], "legs", None, False)


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


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_byte_order_mark(tmp_path, encoding):
    (tmp_path / "legs.toml").write_text('# é\nstore = "mäps"\nbeta = 4\n', encoding=encoding)
    config = find(tmp_path)
    assert (config.store, config.spec.beta) == (tmp_path / "mäps", 4.0)


def test_another_encoding_is_named_with_its_line(tmp_path):
    (tmp_path / "legs.toml").write_bytes(b'beta = 4\nstore = "m\xe4ps"\n')
    with pytest.raises(LegsError, match=r"legs\.toml cannot be read: line 2 is not in UTF-8: store = .m\\xe4ps"):
        find(tmp_path)


def test_the_environment_wins_over_the_file(tmp_path):
    (tmp_path / "legs.toml").write_text('preset = "legs-l"\nbeta = 4\n')
    config = find(tmp_path, LEGS_BETA="7", LEGS_CURVE="C5", LEGS_OPERATOR="scharr", LEGS_P="inf", LEGS_NORMALISE="mean")
    spec = config.spec
    assert (spec.beta, spec.curve, spec.operator, spec.normalise) == (7.0, "C5", "scharr", "mean")
    assert spec.p == float("inf")
    # A preset replaces the file's settings, not only their names.
    assert find(tmp_path, LEGS_PRESET="eggs").spec == PRESETS["eggs"]


@pytest.mark.parametrize(
    ("value", "off"),
    [
        *[(value, True) for value in ("1", "true", "True", "yes", "on", " 1 ")],
        *[(value, False) for value in ("0", "", "false", "False", "no", "off")],
    ],
)
def test_legs_off(value, off):
    assert find(LEGS_OFF=value).off is off


@pytest.mark.parametrize("value", ["2", "of", "disabled", "-1"])
def test_legs_off_that_is_neither_yes_nor_no(value):
    with pytest.raises(LegsError, match=f"LEGS_OFF must be 1 or 0 .*got '{value}'"):
        find(LEGS_OFF=value)


def test_beta_zero_is_unweighted():
    assert find(LEGS_BETA="0").spec.unweighted


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
        (
            'prest = "legs"',
            "legs.toml: unknown setting 'prest'; there are preset, store, operator.*; did you mean 'preset'",
        ),
        ("lambda = 0.2", "unknown setting 'lambda'.*: the share of D-SSIM is the codebase's own setting"),
        ("beta = ", "legs.toml cannot be read"),
    ],
)
def test_a_bad_file_is_named(tmp_path, text, message):
    (tmp_path / "legs.toml").write_text(text)
    with pytest.raises(LegsError, match=message):
        find(tmp_path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("LEGS_PRESET", "legz", "environment variable LEGS_PRESET: no preset is named 'legz': .*did you mean 'legs'"),
        ("LEGS_BETA", "1e300", "environment variable LEGS_BETA: beta must be at least 0 and at most 1e6, got 1e.300"),
        ("LEGS_BETA", "inf", "environment variable LEGS_BETA: beta must be"),
        ("LEGS_BETA", "nan", "environment variable LEGS_BETA: beta must be"),
        ("LEGS_EPS", "1e-60", "environment variable LEGS_EPS: eps must be at least 1e-30"),
        ("LEGS_OPERATOR", "lapacian", "environment variable LEGS_OPERATOR: .*did you mean 'laplacian'"),
    ],
)
def test_a_bad_variable_is_named(name, value, message):
    with pytest.raises(LegsError, match=message):
        find(**{name: value})


def test_an_unknown_variable_is_told_and_has_no_effect():
    config = find(LEGS_BETAA="3", LEGS_TEST_SCENE="fox", LEGS_BACKEND="torch")
    assert config.spec.beta == 10.0
    assert config.notes == (
        "environment variable LEGS_BETAA is not known and has no effect; did you mean 'LEGS_BETA'?",
    )


def test_what_is_near_by_its_beginning_alone_is_not_proposed():
    assert find(LEGS_SEED="3").notes == ("environment variable LEGS_SEED is not known and has no effect",)


def test_the_search_outside_git_ends_at_the_home_folder(tmp_path, monkeypatch):
    home = tmp_path / "home"
    script = home / "code" / "train.py"
    script.parent.mkdir(parents=True)
    script.write_text("")
    (tmp_path / "legs.toml").write_text("beta = 3")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("USERPROFILE", str(home))
    assert find(script).spec.beta == 10.0
    (home / "legs.toml").write_text("beta = 4")
    assert find(script).spec.beta == 4.0


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root to give a file away")
def test_a_file_of_another_owner_is_not_read(tmp_path):
    planted = tmp_path / "legs.toml"
    planted.write_text("beta = 3")
    script = tmp_path / "code" / "train.py"
    script.parent.mkdir()
    script.write_text("")
    os.chown(planted, 12345, -1)
    config = find(script)
    assert config.spec.beta == 10.0
    assert config.notes == (f"{planted} belongs to another user: it is not read",)
    os.chown(script, 12345, -1)  # a checkout of another user that is mounted: its script runs too
    assert find(script).spec.beta == 3.0
