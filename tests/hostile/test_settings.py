"""A legs.toml and LEGS_* variables from a stranger: one line that says where, whatever stands there."""

from __future__ import annotations

import os
import signal

import pytest

from legs_loss.config import find_config
from legs_loss.errors import LegsError
from tests.hostile.forked import forked
from tests.support import colmap_scene, legs

FILES = {
    "no toml": ("preset = ", "cannot be read"),
    "not utf-8": (b"preset = '\xff'", "line 1 is not in UTF-8"),
    "a NUL": ("preset = 'a\0'", "cannot be read"),
    "deep": ("preset = " + "[" * 100_000, "cannot be read"),
    "deep tables": ("[" + ".".join(["a"] * 5_000) + "]", "unknown setting 'a'"),
    "large": ("#" * (2 << 20), "cannot be read"),
    "a number of 5,000 digits": ("beta = " + "9" * 5_000, "cannot be read|must be a number"),
    "a number of 500 digits": ("beta = " + "9" * 500, "beta must be"),
    "twice": ("beta = 1\nbeta = 2", "cannot be read"),
    "an unknown setting": ("betta = 1", "did you mean 'beta'"),
    "a table": ("[beta]\nx = 1", "beta must be a number"),
    "a list": ("beta = [1]", "beta must be a number"),
    "a truth": ("beta = true", "beta must be a number"),
    "a day": ("beta = 2020-01-01", "beta must be a number"),
    "nan": ("beta = nan", "beta must be"),
    "infinite": ("beta = inf", "beta must be"),
    "1e300": ("beta = 1e300", "beta must be"),
    "negative": ("beta = -1", "beta must be"),
    "a preset that is a number": ("preset = 7", "no preset is named 7"),
    "a preset that is a list": ("preset = ['legs']", "no preset is named"),
    "a preset of escapes": ('preset = "\\u001b[2J"', "preset"),
    "a curve that is a list": ("curve = ['C1']", "no curve is named"),
    "an operator that is a table": ("[operator]\na = 1", "no operator is named"),
    "a store that is a list": ("store = ['a']", "store must be a path"),
    "a store with a NUL": ('store = "a\\u0000b"', "store must be a path"),
    "a store in nobody's home": ('store = "~nobody-has-this-name/maps"', "store must be a path"),
    "an old Mac's line ends": ("beta = 1\rcurve = 'C1'\r", "cannot be read"),
}


@pytest.mark.parametrize("what", FILES, ids=lambda what: what.replace(" ", "_"))
def test_a_file(what, tmp_path):
    text, line = FILES[what]
    (tmp_path / ".git").mkdir()
    (tmp_path / "legs.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(LegsError, match=line) as raised:
        find_config(tmp_path, {}, [])
    assert str(tmp_path / "legs.toml") in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1
    assert len(str(raised.value)) < 1000


VARIABLES = {
    "LEGS_BETA": ["x", "nan", "inf", "-1", "1e300", "9" * 5_000, "\udcff"],
    "LEGS_P": ["0", "x", "nan"],
    "LEGS_CURVE": ["C9", "\x1b[2J"],
    "LEGS_PRESET": ["legz", "../legs"],
    "LEGS_OFF": ["2", "maybe"],
    "LEGS_STORE": ["~nobody-has-this-name/x"],
    "LEGS_PERCENTILE": ["101", "-1", "nan"],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in VARIABLES.items() for value in values])
def test_a_variable(name, value):
    with pytest.raises(LegsError, match=name):
        find_config(None, {name: value}, [])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
def test_a_file_that_is_none(tmp_path):
    (tmp_path / ".git").mkdir()
    os.mkfifo(str(tmp_path / "legs.toml"))
    assert find_config(tmp_path, {}, []).source == "defaults"
    (tmp_path / "legs.toml").unlink()
    (tmp_path / "legs.toml").mkdir()
    assert find_config(tmp_path, {}, []).source == "defaults"
    (tmp_path / "legs.toml").rmdir()
    (tmp_path / "legs.toml").symlink_to("legs.toml")
    assert find_config(tmp_path, {}, []).source == "defaults"


def test_an_argument_of_nonsense(tmp_path):
    for scene in ("~nobody-has-this-name", "\udcff", "x" * 5_000):
        assert find_config(None, {}, ["train.py", "-s", scene]).store is None


# What each command reads of a stranger's, where nobody may read it.
READ = {
    "a photograph": ("images/0001.png", ["show", "SCENE/images/0001.png", "--out", "OUT.png"]),
    "a camera": ("sparse/0/cameras.bin", ["precompute", "SCENE", "--workers", "1", "--out", "OUT"]),
    "a pose": ("sparse/0/images.bin", ["precompute", "SCENE", "--workers", "1", "--out", "OUT"]),
    "points": ("sparse/0/points3D.bin", ["train", "SCENE", "--out", "OUT"]),
    "a manifest": ("legs_weights/manifest.json", ["info", "SCENE/legs_weights"]),
    "a map": ("legs_weights/MAP", ["info", "SCENE/legs_weights"]),
    "a store": ("legs_weights", ["info", "SCENE/legs_weights"]),
    "a scene": ("", ["precompute", "SCENE", "--workers", "1", "--out", "OUT"]),
}


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="to become another user needs root")
def test_what_nobody_may_read():
    """As another user, since root may read all: one line that says so, nothing hangs, nothing is written."""
    import shutil
    import tempfile
    from pathlib import Path

    pytest.importorskip("numba")
    pytest.importorskip("matplotlib")
    with tempfile.TemporaryDirectory() as made:  # pytest's own folder is root's alone
        place = Path(made)
        place.chmod(0o755)
        good = colmap_scene(place / "good")
        assert legs("precompute", good, "--workers", 1).returncode == 0
        import legs_loss.cli

        assert legs_loss.cli.main(["info", str(good)]) == 0  # which imports what nobody may not
        for what, (name, arguments) in READ.items():
            scene, out = place / "scene", place / "theirs" / "out"
            shutil.copytree(str(good), str(scene))
            out.parent.mkdir()
            os.chown(str(out.parent), 65534, 65534)
            found = next(scene.glob("legs_weights/*.npy")).name
            (scene / name.replace("MAP", found)).chmod(0)
            words = [word.replace("SCENE", str(scene)).replace("OUT", str(out)) for word in arguments]
            code, said = as_nobody(words)
            assert code in (1, 2), (what, said)
            # Why a map cannot be read is no matter: it is made again.
            assert ("repair the store" if what == "a map" else "Permission denied") in said, (what, said)
            assert "Traceback" not in said
            assert not list(out.parent.rglob("*.part"))
            shutil.rmtree(str(scene))
            shutil.rmtree(str(out.parent))


def as_nobody(arguments):
    """Run ``legs`` in a fork that gives up root; the package's modules that it needs are imported before."""
    import legs_loss.cli
    import legs_loss.cli.info
    import legs_loss.cli.precompute
    import legs_loss.cli.show
    import legs_loss.lab.commands.train
    import legs_loss.precompute

    def command():
        signal.alarm(120)
        os.setgid(65534)
        os.setuid(65534)
        os.environ.update(HOME="/nonexistent", LEGS_TEST="1")
        return legs_loss.cli.main(arguments)

    status, said = forked(command)
    return status >> 8, said
