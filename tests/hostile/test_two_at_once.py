"""Two writers of a file, two trainings, two legs-patch at once; Ctrl-C at any line; the remains of what was killed."""

from __future__ import annotations

import errno
import json
import os
import signal
import struct
import subprocess
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from legs_adapters.checkout import replace
from legs_adapters.checkout.replace import replace_files
from legs_adapters.cli import main
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan, write
from legs_adapters.undo import undo

from legs_loss import LegsError
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.lab.embedded.colmap_writer import write_colmap
from legs_loss.lab.experiments.running import read_json, read_rows
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import read_ply, write_ply
from legs_loss.lab.report.comparison import save_png
from legs_loss.lab.training.checkpoint import read_checkpoint, write_checkpoint, write_json
from legs_loss.precompute import precompute
from legs_loss.scenes import Camera, PointCloud, View, load_training_image, read_scene
from legs_loss.store import StoreWriter, WeightStore
from legs_loss.system import locks
from legs_loss.system.files import write_whole
from tests.hostile.forked import forked
from tests.patcher.support import checkout, legs_patch, snapshot
from tests.support import colmap_scene, legs_command, legs_environment

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


def start(go, command):
    """Fork a process that runs a command when it is told to; return its id and where its words go."""
    read, written = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(go, 1)
        os.dup2(written, 1)
        os.dup2(written, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w", closefd=False), os.fdopen(2, "w", closefd=False)
        code = 99
        try:
            code = command()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    os.close(written)
    return child, read


def together(*commands):
    """Run legs-patch with these arguments, or functions, at the same moment; return each one's exit code and words."""
    go, tell = os.pipe()
    children = [
        start(go, one if callable(one) else lambda one=one: main([str(word) for word in one])) for one in commands
    ]
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


@pytest.mark.parametrize("name", ["ENOLCK", "ENOSYS", "EOPNOTSUPP", "EBADF"])
def test_a_file_system_without_locks(name, tmp_path, monkeypatch):
    """Clusters mount such: what was refused there goes on, and no other writer's work is taken for a killed one's."""

    def flock(*_):
        raise OSError(getattr(errno, name), "no locks")

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    root = checkout(tmp_path / "code", SOURCES)
    assert legs_patch_here(root) == 0
    assert legs_patch_here("--undo", root) == 0
    assert snapshot(root) == PLAIN
    scene = colmap_scene(tmp_path / "scene")
    store = scene / "legs_weights"
    with StoreWriter(store) as another:
        assert locks.is_held(another.staging / ".lock")
        assert len(precompute(read_scene(scene), workers=1).made) == 3
        assert another.staging.is_dir()
    assert WeightStore(store).check() == ([], [])


def test_a_lock_that_fails_otherwise_is_refused(tmp_path, monkeypatch, capsys):
    def flock(*_):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(locks.fcntl, "flock", flock)
    root = checkout(tmp_path, SOURCES)
    assert main([str(root)]) == 2
    assert "Input/output error; nothing was changed" in capsys.readouterr().err
    assert {name: data for name, data in snapshot(root).items() if name in PLAIN} == PLAIN


OURS = (
    "legs_adapters/cli.py",
    "plan.py",
    "undo.py",
    "journal.py",
    "replace.py",
    "locks.py",
    "ctrl_c.py",
    "contextlib.py",
    "shutil.py",
)


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

    def command():
        trace, lines = at_line(number, action)
        sys.settrace(trace)
        code = main([str(word) for word in arguments])
        sys.settrace(None)
        print(f"lines {lines[0]}")
        return code

    return forked(command)


def lines_of(arguments):
    return int(traced(arguments, -1, None)[1].rpartition("lines ")[2])


def interrupted(arguments, root, number):
    """Run legs-patch in a child that gets Ctrl-C before its n-th operation on files of a checkout; return its words."""
    seen = [0]

    def hook(event, found):
        is_there = bool(found) and (str(found[0]).startswith(str(root)) or not os.path.isabs(str(found[0])))
        if is_there and (event == "open" or event.startswith("os.")):  # a name beside a folder's descriptor, too
            seen[0] += 1
            if seen[0] == number:
                os.kill(os.getpid(), signal.SIGINT)

    def command():
        sys.addaudithook(hook)
        return main([str(word) for word in arguments])

    status, said = forked(command)
    return f"{status >> 8} {said}"


PLAIN = {name: text.encode() for name, text in SOURCES.items()}


ARGUMENTS = {"patch": ["--site", "one.py:10"], "undo": ["--undo"], "other settings": ["--preset", "eggs"]}


def prepared(folder, what):
    """Return a checkout for a command, patched already but for the first patch, with legs.toml."""
    root = checkout(folder, SOURCES)
    if what != "patch":
        assert legs_patch_here(root) == 0
    return root


def legs_patch_here(*arguments):
    with open(os.devnull, "w") as nothing, redirect_stdout(nothing):
        return main([str(word) for word in arguments])


@pytest.mark.parametrize("what", ARGUMENTS)
class TestAtAnyLine:
    """Some 20 of the lines, evenly, and each third operation on files; all of them are too many for every run."""

    def points(self, tmp_path, what):
        count = lines_of([*ARGUMENTS[what], prepared(tmp_path / "count", what)])
        assert count > 100
        for number in range(4, count + 1, max(1, count // 20)):
            yield number, prepared(tmp_path / str(number), what)

    def test_ctrl_c_says_what_is_true(self, what, tmp_path):
        said_all = set()
        for number, root in self.points(tmp_path, what):  # from where main is in its try on
            before = snapshot(root)
            arguments = [*ARGUMENTS[what], root]
            status, said = traced(arguments, number, lambda: os.kill(os.getpid(), signal.SIGINT))
            after = snapshot(root)
            assert "Traceback" not in said, (number, said)
            assert status >> 8 == 130, (number, said)
            said_all.add(said.rpartition("interrupted; ")[2])
            check_ended(root, before, after, said)
        assert len(said_all) >= 2, "no interrupt came late"

    def test_ctrl_c_at_every_operation_on_files_leaves_nothing(self, what, tmp_path):
        """A real signal before each: the lock and the staging folder go, whatever stage it comes at."""
        saids, number = [], -1
        while not saids or saids[-1].partition(" ")[0] == "130":
            number += 3
            root = prepared(tmp_path / str(number), what)
            before = snapshot(root)
            saids.append(interrupted([*ARGUMENTS[what], root], root, number))
            check_ended(root, before, snapshot(root), saids[-1])
        assert number > 25 and saids[-1].startswith("0 ")
        assert len({said.rpartition("; ")[2] for said in saids}) >= 3, saids

    def test_a_kill_leaves_nothing_for_ever(self, what, tmp_path):
        for number, root in self.points(tmp_path, what):
            traced([*ARGUMENTS[what], root], number, lambda: os.kill(os.getpid(), signal.SIGKILL))
            if (root / JOURNAL).exists():
                undo(root)
            else:
                write(plan(root))
                undo(root)
            assert snapshot(root) == PLAIN
            assert sorted(path.name for path in root.iterdir()) == sorted(PLAIN)


def check_ended(root, before, after, said):
    """Check that a command that ended said what is true, left nothing of its own, and is undone."""
    assert "Traceback" not in said
    assert not [path for path in root.iterdir() if path.suffix in (".lock", ".tmp")], said
    assert ("nothing was changed" in said) == (after == before), said
    if JOURNAL in after:
        assert legs_patch_here("--undo", root) == 0, said
    assert snapshot(root) == PLAIN


@pytest.mark.parametrize("at", range(1, 4))
def test_other_settings_killed_before_each_rename(at, tmp_path):
    """The journal is written, legs.toml maybe not yet: --undo takes both versions for its own."""
    root = prepared(tmp_path, "other settings")
    child = os.fork()
    if child == 0:
        really, seen = replace._put, []

        def put(*arguments):
            seen.append(arguments)
            if len(seen) == at:
                os.kill(os.getpid(), signal.SIGKILL)
            really(*arguments)

        replace._put = put
        os._exit(legs_patch_here("--preset", "eggs", root))
    assert os.waitpid(child, 0)[1] == (signal.SIGKILL if at < 3 else 0)
    assert ("eggs" in (root / "legs.toml").read_text().partition("\npreset = ")[2].split()[0]) == (at == 3)
    assert legs_patch_here("--undo", root) == 0
    assert snapshot(root) == PLAIN
    assert sorted(path.name for path in root.iterdir()) == sorted(PLAIN)


@pytest.mark.parametrize("what", ["patch", "undo"])
@pytest.mark.slow
def test_a_folder_that_becomes_a_link_at_any_line(what, tmp_path):
    """Whoever may write in the checkout swaps a folder for a link meanwhile: what it leads to stays as it was."""
    sources = {"one.py": TRAIN, "inner/two.py": TRAIN, "inner/utils.py": UTILS, "utils.py": UTILS}

    def fresh(name):
        root = checkout(tmp_path / name, sources)
        if what == "undo":
            write(plan(root))
        precious = {"two.py": b"mine", "utils.py": b"mine"}
        outside = tmp_path / f"{name}-outside"
        if what == "undo":  # what the undo would take for its own
            precious["two.py"] = (root / "inner" / "two.py").read_bytes()
        outside.mkdir()
        for file, data in precious.items():
            (outside / file).write_bytes(data)
        return root, outside, precious

    def swap(root, outside):
        (root / "inner").rename(root / "moved")
        (root / "inner").symlink_to(outside)

    arguments = ["--undo"] if what == "undo" else ["--force"]
    count = lines_of([*arguments, fresh("count")[0]])
    said_all = set()
    for number in range(4, count + 1, max(1, count // 40)):
        root, outside, precious = fresh(str(number))
        _, said = traced([*arguments, root], number, lambda root=root, outside=outside: swap(root, outside))
        assert "Traceback" not in said, (number, said)
        assert snapshot(outside) == precious, number
        said_all.add(said.partition(": ")[2][:20])
    assert len(said_all) >= 2, "no swap came in time"


CHANGES = {f"{number}.py": (b"before", b"after") for number in range(4)}


def save(path, data, how):
    """Save a file as editors do: in place, or whole and renamed; None deletes it."""
    if data is None:
        path.unlink()
    elif how == "in place":
        path.write_bytes(data)
    else:
        (path.parent / "whole").write_bytes(data)
        (path.parent / "whole").rename(path)


@pytest.mark.parametrize("how", ["in place", "renamed"])
@pytest.mark.parametrize("data", [b"mine", None])
@pytest.mark.parametrize("victim", [0, 2, 3])
@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_what_is_saved_before_a_rename_is_not_lost(number, victim, data, how, tmp_path, monkeypatch):
    """It stops the command, which puts all other files back."""
    root = checkout(tmp_path, {name: before for name, (before, _) in CHANGES.items()})
    put, seen = replace._put, []

    def put_after_a_save(*arguments):
        seen.append(arguments)
        if len(seen) == number:
            save(root / f"{victim}.py", data, how)
        put(*arguments)

    monkeypatch.setattr(replace, "_put", put_after_a_save)
    if victim < number - 1:  # it is replaced already: a save after the command
        replace_files(root, CHANGES)
        expected = b"after"
    else:
        with pytest.raises(LegsError, match=f"{victim}.py changed while legs-patch was running: nothing was written"):
            replace_files(root, CHANGES)
        expected = b"before"
    found = dict.fromkeys(CHANGES, expected)
    found[f"{victim}.py"] = data
    assert snapshot(root) == {name: text for name, text in found.items() if text is not None}
    assert not (root / ".legs-patch.tmp").exists()


def test_what_is_saved_over_a_file_is_not_put_back(tmp_path, monkeypatch):
    root = checkout(tmp_path, {name: before for name, (before, _) in CHANGES.items()})
    put = replace._put

    def put_after_a_save(root, path, *arguments):
        if path == "2.py":
            save(root / "0.py", b"mine", "renamed")
            save(root / "2.py", b"mine, too", "renamed")
        put(root, path, *arguments)

    monkeypatch.setattr(replace, "_put", put_after_a_save)
    with pytest.raises(LegsError, match=r"2\.py changed while"):
        replace_files(root, CHANGES)
    expected = {**dict.fromkeys(CHANGES, b"before"), "0.py": b"mine", "2.py": b"mine, too"}
    assert snapshot(root) == expected


@pytest.mark.parametrize("how", ["in place", "renamed"])
def test_what_another_process_saves_while_400_files_are_staged(how, tmp_path):
    changes = {f"{number}.py": (b"before", b"after") for number in range(400)}
    root = checkout(tmp_path, {name: before for name, (before, _) in changes.items()})
    child = os.fork()
    if child == 0:
        until = time.monotonic() + 60
        while time.monotonic() < until:
            try:
                staged = len(os.listdir(str(root / ".legs-patch.tmp")))
            except FileNotFoundError:
                continue
            if staged > 100:
                save(root / "399.py", b"mine", how)
                break
        os._exit(0)
    with pytest.raises(LegsError, match=r"399\.py changed while legs-patch was running"):
        replace_files(root, changes)
    assert os.waitpid(child, 0)[1] == 0
    assert snapshot(root) == {**dict.fromkeys(changes, b"before"), "399.py": b"mine"}


def test_where_nothing_can_be_put_back_the_journal_stays(tmp_path, monkeypatch, capsys):
    """A disk that fails from the third rename on: the message says so, and a later --undo restores every byte."""
    root = checkout(tmp_path, SOURCES)
    with monkeypatch.context() as broken:
        really, calls = os.replace, []

        def fail_from_the_third_on(*arguments, **folders):
            calls.append(arguments)
            if len(calls) > 2:
                raise OSError(5, "Input/output error")
            really(*arguments, **folders)

        broken.setattr(replace.os, "replace", fail_from_the_third_on)
        assert main([str(root)]) == 2
    said = capsys.readouterr().err
    assert f"Input/output error; some files are changed: legs-patch --undo {root}" in said
    assert "nothing was changed" not in said
    assert snapshot(root)["one.py"] != PLAIN["one.py"]
    assert main(["--undo", str(root)]) == 0
    assert snapshot(root) == PLAIN


def access_list(*entries):
    """Return an access list as Linux has it in an extended attribute, of (tag, permissions, id)."""
    return struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *entry) for entry in entries)


NO_ID = 0xFFFFFFFF
OWNER, USER, GROUP, MASK, OTHER = 1, 2, 4, 0x10, 0x20
LIST = access_list((OWNER, 6, NO_ID), (USER, 6, 1234), (GROUP, 0, NO_ID), (MASK, 6, NO_ID), (OTHER, 0, NO_ID))


def attributes(path):
    return {name: os.getxattr(str(path), name) for name in os.listxattr(str(path))}


@pytest.mark.skipif(not hasattr(os, "setxattr"), reason="Linux has them")
def test_attributes_and_access_lists_stay(tmp_path):
    """A file keeps what it has, and gets none of its folder's: neither by a patch nor by its undo."""
    root = checkout(tmp_path, SOURCES)
    one, two = root / "one.py", root / "two.py"
    try:
        os.setxattr(str(one), "user.note", b"mine\0")
        os.setxattr(str(one), "system.posix_acl_access", LIST)
        two.chmod(0o640)
        os.setxattr(str(root), "system.posix_acl_default", LIST)  # for what is made in there from now on
    except OSError as error:
        pytest.skip(f"not in this file system: {error}")
    before = {path: (attributes(path), path.stat().st_mode & 0o7777) for path in (one, two)}
    assert len(before[one][0]) == 2 and not before[two][0]
    for step in (lambda: write(plan(root)), lambda: undo(root)):
        step()
        assert {path: (attributes(path), path.stat().st_mode & 0o7777) for path in (one, two)} == before
    assert snapshot(root) == PLAIN


def test_an_attribute_that_cannot_be_kept_stops_it(tmp_path, monkeypatch, capsys):
    """Without its access list a file would be open to its group."""
    root = checkout(tmp_path, SOURCES)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "listxattr", lambda _: ["security.label", "system.posix_acl_access"], raising=False)
    monkeypatch.setattr(os, "getxattr", lambda *_: b"", raising=False)
    monkeypatch.setattr(os, "setxattr", fail, raising=False)
    assert main([str(root)]) == 2
    assert "No space left on device; nothing was changed" in capsys.readouterr().err
    assert snapshot(root) == PLAIN
    monkeypatch.setattr(os, "listxattr", lambda _: ["security.label"])
    assert main([str(root)]) == 0


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


def test_a_lock_that_is_a_link_or_a_pipe_is_refused(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine\n")
    for name, make in (
        ("link", lambda path: path.symlink_to(tmp_path / "outside")),
        ("hard link", lambda path: os.link(str(precious), str(path))),
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
        assert precious.read_text() == "mine\n"
        assert {path: data for path, data in snapshot(root).items() if path in PLAIN} == PLAIN


def test_a_staging_folder_that_is_a_link_is_refused(tmp_path):
    outside = checkout(tmp_path / "outside", {"precious": "mine\n"})
    root = checkout(tmp_path / "root", SOURCES)
    Path(root / ".legs-patch.tmp").symlink_to(outside)
    done = legs_patch(root)
    assert done.returncode == 2
    assert ".legs-patch.tmp is a link" in done.stderr
    assert (outside / "precious").read_text() == "mine\n"


def some_gaussians(size):
    points = np.random.RandomState(size).rand(size, 3).astype(np.float32)
    return Gaussians.from_points(points, np.full((size, 3), 9, np.uint8), 1)


def colmap(root, size):
    camera = Camera(40, 30, 50.0, 51.0, 20.0, 15.0, np.eye(4))
    points = PointCloud(np.zeros((size, 3), np.float32), np.zeros((size, 3), np.uint8))
    write_colmap(root, {f"{number}.png": camera for number in range(size)}, points)


SIZES = (3, 700)  # of what two processes write at once: the end of the large file is missed if the small one goes first
GAUSSIANS = {size: some_gaussians(size) for size in SIZES}
PIXELS = {size: np.random.RandomState(0).randint(0, 255, (size, 9, 3)).astype(np.uint8) for size in SIZES}
# By the format: its writer of a size, and its reader, which returns the size.
WRITERS = {
    "row": (
        lambda root, size: write_json(root / "row.json", {"n": list(range(size))}),
        lambda root: len(read_json(root / "row.json", ())["n"]),
    ),
    "Gaussians": (
        lambda root, size: write_ply(root / "g.ply", GAUSSIANS[size]),
        lambda root: len(read_ply(root / "g.ply")),
    ),
    "checkpoint": (
        lambda root, size: write_checkpoint(root / "c.npz", {"a": np.zeros(size)}, {"n": size}),
        lambda root: len(read_checkpoint(root / "c.npz")[0]["a"]),
    ),
    "picture": (
        lambda root, size: save_png(PIXELS[size], root / "a.png"),
        lambda root: load_training_image(View("a.png", root / "a.png")).shape[0],
    ),
    "scene": (colmap, lambda root: len(read_scene(root).points.xyz)),
}


@pytest.mark.parametrize("name", WRITERS)
def test_200_pairs_of_each_writer(name, tmp_path):
    write, read = WRITERS[name]
    (tmp_path / "images").mkdir()
    write(tmp_path, SIZES[0])
    children = []
    for size in SIZES:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                for _ in range(200):
                    write(tmp_path, size)
                code = 0
            finally:
                os._exit(code)
        children.append(child)
    reads, codes = [], []
    while len(codes) < len(children):
        reads.append(read(tmp_path))
        done, status = os.waitpid(-1, os.WNOHANG)
        codes += [status] if done in children else []
    assert codes == [0, 0]
    assert set(reads) <= set(SIZES)
    assert len(reads) > 10
    assert not list(tmp_path.rglob("*.part"))


def test_what_a_killed_writer_left_goes_after_an_hour(tmp_path):
    path, others = tmp_path / "a[1].json", tmp_path / "b.json.01234567.part"
    young, old = tmp_path / "a[1].json.01234567.part", tmp_path / "a[1].json.89abcdef.part"
    for part in (young, old, others):
        part.write_text("half")
    for part in (old, others):
        os.utime(str(part), (time.time() - 3700,) * 2)
    write_whole(path, b"whole")
    assert sorted(tmp_path.iterdir()) == sorted([path, young, others])
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"whole", 0o666 & ~umask())


def test_a_folder_is_listed_once_however_many_files_it_gets(tmp_path, monkeypatch):
    listed, real = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda folder: listed.append(folder) or real(folder))
    for number in range(20):
        write_whole(tmp_path / f"{number}.png", b"a mask")
    assert listed == [str(tmp_path)]


def umask():
    old = os.umask(0)
    os.umask(old)
    return old


def at_once(*commands):
    """Run ``legs`` several times at the same moment; return each one's exit code and words."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    running = [subprocess.Popen(legs_command(*words), env=legs_environment(), **pipes) for words in commands]
    results = [(one.communicate(timeout=600)[0], one.returncode) for one in running]
    assert not any("Traceback" in said for said, _ in results), results
    return results


SHORT = ["--iterations", 20, "-r", 2]


@pytest.mark.slow
def test_two_trainings_at_once_make_one_run(tiny_scene, tmp_path):
    pytest.importorskip("numba")
    out = tmp_path / "run"
    results = at_once(*[["train", tiny_scene, "--out", out, "--threads", 1, *SHORT, "--seed", seed] for seed in (1, 2)])
    assert sorted(code for _, code in results) == [0, 2], results
    refused = next(said for said, code in results if code)
    assert "already holds a run" in refused or "another training writes there" in refused
    seed = 1 if results[0][1] == 0 else 2
    assert json.loads((out / "cfg.json").read_text())["seed"] == seed
    assert read_checkpoint(out / "checkpoint.npz")[1]["config"]["seed"] == seed
    assert not list(out.rglob("*.part"))


@pytest.mark.slow
def test_two_comparisons_at_once(tiny_scene, tmp_path):
    pytest.importorskip("numba")
    command = ["compare", tiny_scene, "--arms", "legs", "--processes", 1, "--seeds", 1, *SHORT]
    out = tmp_path / "same"
    for said, code in at_once([*command, "--out", out], [*command, "--out", out]):
        assert code == 0 or "another training writes there" in said, said
    assert [row["arm"] for row in read_rows(out)[1]] == ["3dgs", "legs"]
    assert not list(out.rglob("*.part"))
    assert not list(out.rglob("checkpoint.npz"))
    out = tmp_path / "other"
    results = at_once([*command, "--out", out], [*command, "--out", out, "--iterations", 21])
    assert sorted(code for _, code in results) == [0, 2], results
    assert "was started with another base.iterations" in next(said for said, code in results if code)


class Model:
    """A stand-in for what pycolmap would have found, of a size."""

    images, points3D = {}, {}

    def compute_mean_reprojection_error(self):
        return 0.5


def make_scene(photographs, out, size):
    """Run ``reconstruct`` with stand-ins for pycolmap's steps, and return what it raises, or ""."""
    from legs_loss.lab import reconstruct as module

    def undistort(pycolmap, model, photographs, work, *_):
        (work / "scene" / "images").mkdir(parents=True)
        for number in range(size):
            (work / "scene" / "images" / f"{number}.png").write_text(str(size))
        return work / "scene"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_pycolmap", lambda: None)
        patch.setattr(module, "_extract", lambda *_: None)
        patch.setattr(module, "_match", lambda *_: None)
        patch.setattr(module, "_map", lambda *_: Model())
        patch.setattr(module, "_undistort", undistort)
        try:
            module.reconstruct(photographs, out)
        except LegsError as error:
            return str(error)
    return ""


@pytest.mark.slow
def test_100_pairs_of_scenes(tmp_path):
    """One of them makes the folder, whole; the other says that it is there."""
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for number in range(3):
        (photographs / f"{number}.png").write_bytes(b"a photograph")
    both = 0
    for pair in range(100):
        out, ended = tmp_path / f"out{pair}", []
        go, tell = os.pipe()
        for size in (2, 40):
            read, written = os.pipe()
            child = os.fork()
            if child == 0:
                os.read(go, 1)
                os.write(written, make_scene(photographs, out, size).encode())
                os._exit(0)
            os.close(written)
            ended.append((child, read))
        os.write(tell, b"..")
        said = []
        for child, read in ended:
            with os.fdopen(read) as file:
                said.append(file.read())
            assert os.waitpid(child, 0)[1] == 0
        os.close(go)
        os.close(tell)
        assert sorted(bool(error) for error in said) == [False, True], said
        both += "meanwhile" in "".join(said)
        assert all("exists already" in error or "meanwhile" in error for error in said if error)
        assert {path.read_text() for path in (out / "images").iterdir()} == {str(len(os.listdir(str(out / "images"))))}
    assert both, "never at the same moment"
    assert not list(tmp_path.glob(".*")), "what was begun is swept"


@pytest.mark.slow
def test_two_legs_scene_at_once(tmp_path):
    pytest.importorskip("pycolmap")
    drawn = write_embedded_scene(tmp_path / "drawn", views=16, width=320, height=240, points=500)
    command = ["scene", drawn / "images", tmp_path / "out", "--threads", 1]
    results = at_once(command, command)
    assert sorted(code == 2 for _, code in results) == [False, True], results
    refused = next(said for said, code in results if code == 2)
    assert "exists already" in refused or "made by another meanwhile" in refused
    assert len(read_scene(tmp_path / "out").views) > 8
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawn", "out"]
