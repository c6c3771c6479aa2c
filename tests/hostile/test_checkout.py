"""A checkout's files beside Python: pipes, sockets, devices, links, files of gigabytes, names of any bytes."""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import sys
from pathlib import Path

import pytest
from legs_adapters import verify as verifying
from legs_adapters.cli import main
from legs_adapters.journal import JOURNAL

from tests.patcher.support import checkout, files

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A checkout with all of these files in it."""
    root = checkout(tmp_path / "stranger", files("inria"))
    for name in ("pipe.py", "data", ".gitmodules", "arguments/pipe.py"):
        (root / name).parent.mkdir(exist_ok=True)
        os.mkfifo(str(root / name))
    listening = socket.socket(socket.AF_UNIX)
    monkeypatch.chdir(root)  # the name of a socket has at most some 100 bytes
    listening.bind("socket.py")
    (root / "loop").symlink_to(".")
    (root / "nowhere.py").symlink_to("nowhere")
    (root / "zero.py").symlink_to("/dev/zero")
    (root / "folder.py").mkdir()
    (root / ("n" * 250 + ".py")).write_text("x = 1\n")
    with open(os.fsencode(str(root)) + b"/\xff\xfe.py", "w") as file:
        file.write("x = 1\n")
    with open(str(root / "huge.py"), "wb") as file:
        file.truncate(3 << 30)
    signal.alarm(200)
    yield root
    signal.alarm(0)
    listening.close()


def test_every_mode_ends(stranger, capsys):
    before = (stranger / "train.py").read_bytes()
    plain = sorted(os.listdir(os.fsencode(str(stranger))))
    leave = ["--exclude", "pipe.py", "--exclude", "huge.py", "--exclude", "socket.py"]
    for arguments, code in (
        (["--check"], 1),
        (["--check", *leave], 1),
        (["--diff"], 0),
        ([], 0),
        (["--undo", "--diff"], 0),
        (["--undo"], 0),
    ):
        assert main([*arguments, str(stranger)]) == code, capsys.readouterr()
        said = "".join(capsys.readouterr())
        assert "Traceback" not in said
        if arguments == ["--check"]:
            unread = {line.split()[0]: line for line in said.splitlines() if " not read " in line}
            assert "larger than 1 MiB" in unread["huge.py"]
    assert (stranger / "train.py").read_bytes() == before
    assert sorted(os.listdir(os.fsencode(str(stranger)))) == plain


def test_verify_copies_what_is_a_file(stranger, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(
        verifying, "run_watched", lambda root, *_: seen.append(sorted(os.listdir(str(root)))) or run_of_none()
    )
    monkeypatch.setattr(verifying, "_claims", lambda runs, _: {"all copied": True})
    monkeypatch.setattr(verifying, "check_imports", lambda *_: None)
    assert main(["--verify", str(stranger)]) == 0, capsys.readouterr()
    assert len(seen) == 3
    for names in seen:
        assert "train.py" in names
        assert not {"pipe.py", "data", "socket.py", "huge.py"} & set(names)


def run_of_none():
    return verifying.Run(0, ["0x1p+0"])


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("other", ["--verify", "--undo", "--preset"])
def test_verify_beside_another(other, number, tmp_path, monkeypatch):
    """A whole patch is compared with a whole original, or the message says that there is none any more."""
    from tests.hostile.test_two_at_once import SOURCES, together

    root = checkout(tmp_path / "root", {**SOURCES, "train.py": SOURCES["one.py"]})
    assert main([str(root)]) == 0
    monkeypatch.setattr(verifying, "check_imports", lambda *_: None)
    monkeypatch.setattr(verifying, "run_watched", look)
    monkeypatch.setattr(verifying, "_claims", lambda runs, _: {"whole": all(run.code == 0 for run in runs.values())})
    monkeypatch.setattr("legs_loss.lab.embedded.write_embedded_scene", lambda place, **_: place)
    monkeypatch.setattr("legs_loss.scenes.read_scene", lambda place: place)
    monkeypatch.setattr("legs_loss.precompute.precompute", lambda scene, store: None)
    verify = ["--verify", "--script", "train.py", root]
    beside = {"--verify": verify, "--undo": ["--undo", root], "--preset": ["--preset", "eggs", root]}[other]
    (verified, said), (code, more) = together(verify, beside)
    assert verified == 0 or "not patched" in said or "nothing was written" in said, said
    assert code == 0 or "not patched" in more or "nothing was written" in more, more
    if (root / JOURNAL).exists():
        assert main(["--undo", str(root)]) == 0
    shutil.rmtree(str(root / "__pycache__"), ignore_errors=True)
    found = {path.name: path.read_text() for path in Path(root).iterdir()}
    assert found == {**SOURCES, "train.py": SOURCES["one.py"]}


def look(root, _, command, *others):
    """Stand in for a training: exit code 0 where the copy is wholly patched, or wholly not."""
    patched = "legs_loss.l1_loss" in (root / command.script).read_text()
    wanted = root.parent.name != "unpatched"
    return run_of_none()._replace(code=0 if patched == wanted else 1)


# Added to a training script: what Python does not compile.
NOT_COMPILED = {
    "Python 2's except": "try:\n    x = 1\nexcept ValueError, error:\n    pass\n",
    "a statement cut short": "x = 1 2\n",
    "a return outside of a function": "return\n",
    "a name both own and outer": "def f():\n    nonlocal x\n",
    "an argument twice": "def f(a, a):\n    pass\n",
    "an assignment to a call": "f() = 1\n",
    "indentation of nothing": "def f():\n    x = 1\n      y = 2\n",
}


@pytest.mark.parametrize("what", NOT_COMPILED, ids=lambda what: what.replace(" ", "_"))
def test_what_python_cannot_compile_is_not_patched(what, tmp_path, capsys):
    """One line says so; the checkout's other scripts are patched, and alone it is an error."""
    if what.startswith("Python 2") and sys.version_info >= (3, 14):
        pytest.skip("Python has this syntax again")
    good = files("inria")
    bad = {"train2.py": good["train.py"] + "\n\n" + NOT_COMPILED[what]}
    root = checkout(tmp_path / "both", {**good, **bad})
    assert main([str(root)]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("train2.py")]
    assert re.match(r"train2.py +not read +(Python 3\S+ cannot compile it: |does not parse \(line)", line)
    assert (root / "train2.py").read_text() == bad["train2.py"]
    assert "legs_loss" in (root / "train.py").read_text()
    alone = checkout(tmp_path / "alone", {**good, "train.py": bad["train2.py"]})
    assert main([str(alone)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "not read: train.py: " in error
    assert sorted(os.listdir(str(alone))) == sorted(os.listdir(str(checkout(tmp_path / "as before", good))))
