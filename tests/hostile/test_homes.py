"""Homes that cannot be written: a read-only mount, none, a file in its place; beside a package that is read-only."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.hostile.test_code_cache import STEP
from tests.patcher.support import checkout, files, snapshot
from tests.support import ROOT, colmap_scene, legs_environment

pytest.importorskip("numba")
pytestmark = [
    pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="mounting needs root, and Linux"),
    pytest.mark.slow,
]


def mount(*words):
    made = subprocess.run(["mount", *map(str, words)], stderr=subprocess.PIPE, text=True)
    if made.returncode:
        pytest.skip(f"cannot mount: {made.stderr.strip()}")


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A read-only home, and the packages where numba cannot write beside them either."""
    folder = tmp_path_factory.mktemp("homes")
    mounted = [folder / "home", folder / "packages"]
    for path in mounted:
        path.mkdir()
    try:
        mount("-t", "tmpfs", "-o", "ro,size=1m", "tmpfs", mounted[0])
        mount("--bind", ROOT, mounted[1])
        mount("-o", "remount,ro,bind", mounted[1])
        (folder / "file").write_text("")
        yield folder
    finally:
        for path in mounted:
            subprocess.run(["umount", "-l", str(path)], stderr=subprocess.DEVNULL)


def run(places, tmp_path, *words, **environment):
    """Run Python with the read-only packages and return what it printed and said; None unsets a variable."""
    packages = [str(places / "packages"), str(places / "packages" / "adapters")]
    paths = os.pathsep.join([*packages, *(path for path in sys.path if path and str(ROOT) not in path)])
    given = {**legs_environment(), "NUMBA_CACHE_DIR": "", "PYTHONPATH": paths, **environment}
    given = {name: str(value) for name, value in given.items() if value is not None}
    done = subprocess.run(
        [sys.executable, *map(str, words)], cwd=str(tmp_path), env=given, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout, done.stderr


@pytest.mark.parametrize("home", ["read-only", "missing", "a file", "XDG_CACHE_HOME is a file"])
def test_the_loss_a_store_and_a_patch(home, places, tmp_path):
    """The loss is the fast one, right, and one line says that its code is not kept."""
    nowhere = {"read-only": places / "home", "missing": "/proc/none", "a file": places / "file"}
    environment = {"HOME": nowhere.get(home, places / "home"), "XDG_CACHE_HOME": None}
    if "XDG" in home:
        environment["XDG_CACHE_HOME"] = places / "file"
    scene = colmap_scene(tmp_path / "scene")
    assert ": 3 made" in run(places, tmp_path, "-m", "legs_loss", "precompute", scene, "--workers", 1, **environment)[0]
    if home == "read-only":  # it compiles for some seconds
        out, said = run(places, tmp_path, "-c", STEP, **environment)
        assert out == "_FusedLossBackward True\n"
        assert said.count("every run compiles anew") == 1 and "NUMBA_CACHE_DIR" in said
    root = checkout(tmp_path / "code", files("inria"))
    before = snapshot(root)
    for arguments in ([root], ["--undo", root]):
        run(places, tmp_path, "-m", "legs_adapters.cli", *arguments, **environment)
    assert snapshot(root) == before


def test_a_user_without_a_home(places, tmp_path):
    """No HOME and no line in the list of users, as in many containers: there is no cache, and a ~ is one error."""
    from legs_loss.config import LegsError, find_config
    from legs_loss.kernels.cuda.modules import cache_folder
    from tests.hostile.forked import forked

    def command():
        os.setuid(64003)
        os.environ.pop("HOME", None)
        os.environ["LEGS_STORE"] = "~/store"
        assert cache_folder({}) is None
        try:
            find_config(tmp_path, argv=[])
        except LegsError as error:
            print(error)
        return 0

    status, said = forked(command)
    assert (status, said.count("\n")) == (0, 1), said
    assert "store must be a path, got '~/store', and there is no such user" in said
