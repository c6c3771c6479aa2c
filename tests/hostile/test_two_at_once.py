"""Two legs-patch at once, Ctrl-C at any line, and the remains of a killed one: real processes, whatever the timing."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import pytest
from legs_adapters.checkout import replace
from legs_adapters.cli import main
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan, write
from legs_adapters.undo import undo

from tests.patcher.support import checkout, legs_patch, snapshot

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork, to start at the same moment")

TRAIN = """\
import torch
from utils import l1_loss
from gaussian_renderer import render


def training(scene, gaussians):
    for viewpoint_cam in scene:
        image = render(viewpoint_cam, gaussians, None, None)["render"]
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        Ll1.backward()
"""
UTILS = "def l1_loss(network_output, gt):\n    return (network_output - gt).abs().mean()\n"
SOURCES = {"one.py": TRAIN, "two.py": TRAIN, "utils.py": UTILS}
PAIRS = 12


def start(go, *arguments):
    """Fork a process that runs legs-patch when it is told to; return its id and where its words go."""
    read, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(go, 1)
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = 99
        try:
            code = main([str(word) for word in arguments])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(written)
    return child, read


def together(*commands):
    """Run commands at the same moment; return each one's exit code and words."""
    go, tell = os.pipe()
    children = [start(go, *arguments) for arguments in commands]
    os.write(tell, b"." * len(children))
    results = []
    for child, words in children:
        with os.fdopen(words) as file:
            said = file.read()
        results.append((os.waitpid(child, 0)[1] >> 8, said))
        assert "Traceback" not in said
    os.close(go)
    os.close(tell)
    return results


@pytest.mark.parametrize("number", range(PAIRS))
class TestPairs:
    def test_two_undos(self, number, tmp_path):
        root = checkout(tmp_path, SOURCES)
        write(plan(root))
        results = together(["--undo", root], ["--undo", root])
        assert sorted(code for code, _ in results) == [0, 2]
        assert any("nothing to undo" in said for code, said in results if code == 2)
        assert snapshot(root) == {name: text.encode() for name, text in SOURCES.items()}

    def test_two_patches_of_different_files(self, number, tmp_path):
        root = checkout(tmp_path, SOURCES)
        results = together(*(["--site", f"{name}:10", root] for name in ("one.py", "two.py")))
        assert [code for code, _ in results] == [0, 0], results
        assert all(b"legs_loss.l1_loss" in snapshot(root)[name] for name in ("one.py", "two.py"))
        undo(root)
        assert snapshot(root) == {name: text.encode() for name, text in SOURCES.items()}

    def test_two_patches_of_the_same_files(self, number, tmp_path):
        root = checkout(tmp_path, SOURCES)
        results = together([root], [root])
        for code, said in results:
            assert code == 0 or "changed while legs-patch was running: nothing was written; run it again" in said
        assert 0 in [code for code, _ in results]
        undo(root)
        assert snapshot(root) == {name: text.encode() for name, text in SOURCES.items()}

    def test_a_patch_beside_an_undo(self, number, tmp_path):
        root = checkout(tmp_path, SOURCES)
        write(plan(root, by_hand=[("one.py", 10)]))
        before = snapshot(root)
        (patched, _), (undone, said) = together(["--site", "two.py:10", root], ["--undo", root])
        assert undone == 0, said
        assert patched == 0
        if (root / JOURNAL).exists():  # the undo came first
            assert snapshot(root) != before
            undo(root)
        assert snapshot(root) == {name: text.encode() for name, text in SOURCES.items()}


def test_who_holds_the_lock_is_said(tmp_path, monkeypatch, capsys):
    root = checkout(tmp_path, SOURCES)
    write(plan(root))
    monkeypatch.setattr(replace, "_WAIT", 0.3)
    ready, done = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        with replace.locked(root, "legs-patch --undo here"):
            os.write(ready[1], b".")
            os.read(done[0], 1)
        os._exit(0)
    os.read(ready[0], 1)
    before = snapshot(root)
    assert main(["--undo", str(root)]) == 2
    said = capsys.readouterr().err
    assert f"another legs-patch is running in {root}: process {child} (legs-patch --undo here); nothing was" in said
    assert snapshot(root) == before
    os.write(done[1], b".")
    os.waitpid(child, 0)
    assert main(["--undo", str(root)]) == 0
    assert not list(root.glob(".legs-patch*"))


OURS = ("legs_adapters/cli.py", "plan.py", "undo.py", "journal.py", "replace.py", "locks.py", "interrupts.py")


def at_line(number, action):
    """Return a trace function that acts at the n-th line of the modules that write."""
    lines = [0]

    def trace(frame, event, _):
        if not frame.f_code.co_filename.endswith(OURS):
            return None
        if event == "line":
            lines[0] += 1
            if lines[0] == number:
                action()
        return trace

    return trace, lines


def traced(arguments, number, action):
    """Run legs-patch in a child that acts on itself at the n-th line; return its status, words and line count."""
    read, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        trace, lines = at_line(number, action)
        code = 99
        try:
            sys.settrace(trace)
            code = main([str(word) for word in arguments])
            sys.settrace(None)
            print(f"lines {lines[0]}")
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(written)
    with os.fdopen(read) as file:
        said = file.read()
    return os.waitpid(child, 0)[1], said


def lines_of(arguments):
    return int(traced(arguments, -1, None)[1].rpartition("lines ")[2])


PLAIN = {name: text.encode() for name, text in SOURCES.items()}


@pytest.mark.parametrize("what", ["patch", "undo"])
class TestAtAnyLine:
    """Some 30 of the lines, evenly; all of them are too many for every run."""

    def points(self, tmp_path, what):
        root = checkout(tmp_path / "count", SOURCES)
        arguments = ["--site", "one.py:10", root] if what == "patch" else ["--undo", root]
        if what == "undo":
            write(plan(root))
        count = lines_of(arguments)
        assert count > 100
        for number in range(3, count + 1, max(1, count // 30)):
            fresh = checkout(tmp_path / str(number), SOURCES)
            if what == "undo":
                write(plan(fresh))
            yield number, [*arguments[:-1], fresh], fresh

    def test_ctrl_c_says_what_is_true(self, what, tmp_path):
        said_all = set()
        for number, arguments, root in self.points(tmp_path, what):  # from where main is in its try on
            before = snapshot(root)
            status, said = traced(arguments, number, lambda: os.kill(os.getpid(), signal.SIGINT))
            after = {name: data for name, data in snapshot(root).items() if name != ".legs-patch.lock"}
            assert "Traceback" not in said, (number, said)
            assert status >> 8 == 130, (number, said)
            said_all.add(said.rpartition("interrupted; ")[2])
            assert ("nothing was changed" in said) == (after == before), (number, said)
            if what == "patch" and after != before:
                undo(root)
            if what == "patch" or after != before:
                assert {name: data for name, data in snapshot(root).items() if name in PLAIN} == PLAIN
        assert len(said_all) >= 2, "no interrupt came late"

    def test_a_kill_leaves_nothing_for_ever(self, what, tmp_path):
        for number, arguments, root in self.points(tmp_path, what):
            traced(arguments, number, lambda: os.kill(os.getpid(), signal.SIGKILL))
            if (root / JOURNAL).exists():
                undo(root)
            else:
                write(plan(root))
                undo(root)
            assert snapshot(root) == PLAIN
            assert sorted(path.name for path in root.iterdir()) == sorted(PLAIN)


def test_the_owner_stays(tmp_path):
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    root = checkout(tmp_path, SOURCES)
    os.chown(str(root / "one.py"), 1234, 2345)
    os.chmod(str(root / "one.py"), 0o6755)
    for step in (lambda: write(plan(root)), lambda: undo(root)):
        step()
        found = os.stat(str(root / "one.py"))
        assert (found.st_uid, found.st_gid, found.st_mode & 0o7777) == (1234, 2345, 0o6755)


@pytest.mark.parametrize("writable", [True, False])
def test_another_user_s_files(writable):
    """With write access to the folder, patch and undo keep the mode; without it, one line, and nothing changes."""
    if os.geteuid() != 0:
        pytest.skip("to become another user needs root")
    with tempfile.TemporaryDirectory() as made:  # pytest's own folder is root's alone
        os.chmod(made, 0o755)
        write(plan(checkout(Path(made) / "another", SOURCES)))  # which imports what nobody may not
        (Path(made) / "state").mkdir()
        os.chown(str(Path(made) / "state"), NOBODY, NOBODY)
        root = checkout(Path(made) / "theirs", SOURCES)
        os.chmod(str(root), 0o777 if writable else 0o755)
        for name in SOURCES:
            os.chmod(str(root / name), 0o664)
        for arguments in ([root], ["--undo", root]):
            code, said = as_nobody(arguments)
            if not writable:
                assert (code, "Permission denied; nothing was changed" in said) == (2, True), said
                assert "Traceback" not in said
                assert snapshot(root) == PLAIN
                continue
            assert code == 0, said
            found = os.stat(str(root / "one.py"))
            assert (found.st_uid, found.st_mode & 0o7777) == (NOBODY, 0o664)
        assert snapshot(root) == PLAIN


NOBODY = 65534


def as_nobody(arguments):
    """Run legs-patch in a fork that gives up root; return its exit code and words."""
    read, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = 99
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            os.environ["XDG_STATE_HOME"] = str(Path(arguments[-1]).parent / "state")
            code = main([str(word) for word in arguments])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(written)
    with os.fdopen(read, errors="replace") as file:
        said = file.read()
    return os.waitpid(child, 0)[1] >> 8, said


def test_a_lock_that_is_a_link_or_a_pipe_is_refused(tmp_path):
    for name, make in (
        ("link", lambda path: path.symlink_to(tmp_path / "outside")),
        ("pipe", lambda path: os.mkfifo(path)),
    ):
        root = checkout(tmp_path / name, SOURCES)
        make(root / ".legs-patch.lock")
        began = time.monotonic()
        done = legs_patch(root)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert ".legs-patch.lock" in done.stderr
        assert time.monotonic() - began < 60
        assert not (tmp_path / "outside").exists()
        assert {path: data for path, data in snapshot(root).items() if path in PLAIN} == PLAIN


def test_a_staging_folder_that_is_a_link_is_refused(tmp_path):
    outside = checkout(tmp_path / "outside", {"precious": "mine\n"})
    root = checkout(tmp_path / "root", SOURCES)
    Path(root / ".legs-patch.tmp").symlink_to(outside)
    done = legs_patch(root)
    assert done.returncode == 2
    assert ".legs-patch.tmp is a link" in done.stderr
    assert (outside / "precious").read_text() == "mine\n"
