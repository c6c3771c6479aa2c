"""Two users of one machine on one checkout and on one store: forks of the tests' own process that give up root."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from pathlib import Path

import pytest
import torch
from legs_adapters.cli import main as legs_patch

import legs_loss
from legs_loss.cli import main as legs
from legs_loss.runtime import state as state_of_run
from legs_loss.scenes import View, image_tensor, load_training_image
from legs_loss.store import WeightStore
from tests.hostile.forked import forked
from tests.hostile.test_two_at_once import PLAIN, SOURCES, together
from tests.patcher.support import checkout, snapshot
from tests.support import colmap_scene

pytestmark = pytest.mark.skipif(
    os.name != "posix" or os.geteuid() != 0, reason="to become other users needs root, on POSIX"
)

ALICE, BOB, TEAM = 64001, 64002, 64000


def become(user, umask):
    os.setgroups([TEAM])
    os.setgid(user)
    os.setuid(user)
    os.umask(umask)
    torch.set_num_threads(1)  # OpenMP's threads are not in a fork, and torch would wait for them


def by(user, main, *arguments, umask=0o022):
    """Return a function that runs a command as a user, in a fork."""

    def command():
        become(user, umask)
        return main([str(word) for word in arguments])

    return command


def run(*given, **options):
    """Run a command as a user; return its exit code and words."""
    status, said = forked(by(*given, **options))
    assert "Traceback" not in said
    print(said)
    return status >> 8, said


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    """Import, as root, what the forks may not read."""
    folder = tmp_path_factory.mktemp("first")
    root, scene = checkout(folder / "root", SOURCES), colmap_scene(folder / "scene", width=40, height=30)
    assert legs_patch([str(root)]) == legs_patch(["--undo", str(root)]) == 0
    assert legs(["precompute", str(scene), "--workers", "1"]) == legs(["info", str(scene)]) == 0
    return scene


@pytest.fixture
def place(imported):
    """A folder that both may enter, as pytest's own is not, with a scene."""
    with tempfile.TemporaryDirectory() as made:
        os.chmod(made, 0o755)
        for part in ("images", "sparse"):
            shutil.copytree(str(imported / part), str(Path(made) / "scene" / part))
        yield Path(made)


def give(root, mode, file_mode=0o664, user=ALICE, group=TEAM):
    """Give a folder and all in it to a user and a group."""
    for path in [root, *root.rglob("*")]:
        os.chown(str(path), user, group)
        os.chmod(str(path), mode if path.is_dir() else file_mode)
    return root


def state(path):
    found = os.stat(str(path))
    return found.st_uid, found.st_gid, stat.S_IMODE(found.st_mode)


@pytest.mark.parametrize("mode", [0o775, 0o2775, 0o777])
def test_what_one_patches_the_other_undoes(mode, place):
    """The files stay the team's, whoever was the last."""
    root = give(checkout(place / "theirs", SOURCES), mode)
    for first, second in ((ALICE, BOB), (BOB, ALICE)):
        assert run(first, legs_patch, root)[0] == 0
        assert state(root / "one.py") == (first, TEAM, 0o664)
        code, said = run(second, legs_patch, "--preset", "eggs", root)
        assert code == 0, said
        code, said = run(second, legs_patch, "--undo", root)
        assert code == 0, said
        assert state(root / "one.py") == (second, TEAM, 0o664)
        assert snapshot(root) == PLAIN


@pytest.mark.parametrize(("mode", "made"), [(0o664, 0o644), (0o646, 0o666), (0o6755, 0o755), (0o604, 0o644)])
def test_a_group_that_cannot_be_kept_gets_nothing_more_than_others(mode, made, place):
    root = give(checkout(place / "theirs", SOURCES), 0o777, mode, group=ALICE)
    assert run(BOB, legs_patch, root)[0] == 0
    assert state(root / "one.py") == (BOB, BOB, made)


def test_without_write_access_it_is_one_line(place):
    root = give(checkout(place / "theirs", SOURCES), 0o755, 0o644)
    for arguments in ([root], ["--undo", root], ["--preset", "eggs", root]):
        code, said = run(BOB, legs_patch, *arguments)
        assert (code, said.count("error:"), "Permission denied; nothing was changed" in said) == (2, 1, True), said
    assert run(BOB, legs_patch, "--check", root)[0] == 1
    assert snapshot(root) == PLAIN
    assert run(ALICE, legs_patch, root, umask=0o077)[0] == 0
    patched = snapshot(root)
    code, said = run(BOB, legs_patch, "--undo", root)
    assert (code, "Permission denied" in said) == (2, True)
    assert snapshot(root) == patched


@pytest.mark.parametrize("number", range(4))
@pytest.mark.parametrize("umask", [0o002, 0o022])
def test_both_patch_at_once(umask, number, place):
    root = give(checkout(place / "theirs", SOURCES), 0o2775)
    sites = [["--site", "one.py:10", root], ["--site", "two.py:10", root]]
    results = together(*(by(who, legs_patch, *site, umask=umask) for who, site in zip((ALICE, BOB), sites)))
    assert [code for code, _ in results] == [0, 0], results
    assert all(b"legs_loss.l1_loss" in snapshot(root)[name] for name in ("one.py", "two.py"))
    results = together(*(by(who, legs_patch, "--undo", root, umask=umask) for who in (ALICE, BOB)))
    assert sorted(code for code, _ in results) == [0, 2], results
    assert snapshot(root) == PLAIN
    assert sorted(path.name for path in root.iterdir()) == sorted(SOURCES)


def test_what_the_other_s_killed_command_left(place):
    """A lock is only a file; a staging folder is its owner's alone, and is named."""
    root = give(checkout(place / "theirs", SOURCES), 0o2775)
    lock, staging = root / ".legs-patch.lock", root / ".legs-patch.tmp"
    lock.write_text("process 1")
    os.chmod(str(lock), 0o644)
    staging.mkdir()
    (staging / "0123").write_text("x")
    for path in (lock, staging, staging / "0123"):
        os.chown(str(path), ALICE, ALICE)
    os.chmod(str(staging), 0o700)
    code, said = run(BOB, legs_patch, root)
    assert (code, f"{staging} is what another user's killed legs-patch left" in said) == (2, True), said
    assert not lock.exists()
    assert run(ALICE, legs_patch, root)[0] == 0
    assert run(BOB, legs_patch, "--undo", root)[0] == 0
    assert snapshot(root) == PLAIN


def test_uncommitted_changes_are_the_other_s_to_lose(place):
    """git itself would not answer about a checkout of somebody else's."""
    root = give(checkout(place / "theirs", SOURCES, git=True), 0o2775)
    (root / "one.py").write_text(SOURCES["one.py"] + "# mine\n")
    code, said = run(BOB, legs_patch, root)
    assert (code, "uncommitted changes in what would be patched (one.py)" in said) == (2, True), said


def test_a_folder_that_may_not_be_entered_is_not_read(place):
    root = give(checkout(place / "theirs", {**SOURCES, "private/train.py": SOURCES["one.py"]}), 0o2775)
    os.chmod(str(root / "private"), 0o700)
    code, said = run(BOB, legs_patch, root)
    assert code == 0, said
    assert [line.split(None, 1)[1] for line in said.splitlines() if line.startswith("private ")] == [
        "not read  cannot be read: Permission denied"
    ]


def step(store, photo):
    """Return a function that takes a step on a view with a store and says the loss."""

    def command(_):
        state_of_run.reset()  # the fork's run is its own, with a first step that is said
        legs_loss.configure(store=store)
        target = image_tensor(load_training_image(View(photo.name, photo)))
        for _ in range(2):
            loss = legs_loss.l1_loss(torch.full_like(target, 0.5).requires_grad_(), target, view=photo.stem)
        print(f"loss {loss.item():.4f}")
        return 0

    return command


def loss_of(said):
    return said.partition("loss ")[2].split("\n")[0]


class TestStore:
    @pytest.fixture
    def store(self, place):
        (place / "store").mkdir()
        return give(place / "store", 0o2775)

    def precompute(self, store, *more):
        return ["precompute", store.parent / "scene", "--out", store, "--workers", 1, *more]

    @pytest.mark.parametrize("umask", [0o002, 0o022])
    def test_what_one_writes_the_other_reads_and_adds_to(self, umask, store, place):
        photo = place / "scene" / "images" / "0001.png"
        _, computed = run(BOB, step(None, photo))
        assert run(ALICE, legs, *self.precompute(store), umask=umask)[0] == 0
        code, said = run(BOB, step(store, photo))
        assert (code, "maps from" in said) == (0, True), said
        assert abs(float(loss_of(said)) - float(loss_of(computed))) < 1e-3
        for who, size in ((BOB, 2), (ALICE, 4)):
            code, said = run(who, legs, *self.precompute(store, "-r", size), umask=umask)
            assert (code, ": 3 made" in said) == (0, True), said
        assert WeightStore(store).check() == ([], [])
        assert len(WeightStore(store).entries) == 9

    @pytest.mark.parametrize("number", range(3))
    @pytest.mark.parametrize("umask", [0o002, 0o022])
    def test_both_write_at_once(self, umask, number, store):
        sizes = zip((ALICE, BOB), (1, 2))
        both = [by(who, legs, *self.precompute(store, "-r", size), umask=umask) for who, size in sizes]
        results = together(*both)
        assert [code for code, _ in results] == [0, 0], results
        assert WeightStore(store).check() == ([], [])
        assert len(WeightStore(store).entries) == 6
        assert not [path for path in store.iterdir() if path.name.startswith(".writing")]

    def test_maps_that_the_other_may_not_read_are_computed(self, store, place):
        photo = place / "scene" / "images" / "0001.png"
        _, computed = run(BOB, step(None, photo))
        assert run(ALICE, legs, *self.precompute(store), umask=0o077)[0] == 0
        for closed in (store / "manifest.json", *store.glob("*.npy"), store):
            code, said = run(BOB, step(store, photo))
            assert (code, loss_of(said)) == (0, loss_of(computed)), said
            assert said.count("Permission denied") == 1
            code, said = run(BOB, legs, "info", store)
            errors = [line for line in said.splitlines() if "error:" in line]
            assert (code > 0, len(errors)) == (True, 1), said
            os.chmod(str(closed), 0o644)
            if closed.suffix == ".npy":
                os.chmod(str(store), 0o700)
        assert run(BOB, legs, *self.precompute(store))[0] == 2

    def test_without_write_access_it_is_one_line(self, store):
        assert run(ALICE, legs, *self.precompute(store))[0] == 0
        os.chmod(str(store), 0o755)
        code, said = run(BOB, legs, *self.precompute(store, "-r", "2"))
        assert (code, said) == (2, f"legs: error: cannot write to {store}: Permission denied\n")
        assert WeightStore(store).check() == ([], [])

    def test_a_current_folder_that_may_not_be_entered(self, store, monkeypatch):
        """As after `sudo -u`: processes cannot be started in it, and nothing is said of memory."""
        closed = store.parent / "closed"
        closed.mkdir(mode=0o700)
        monkeypatch.chdir(closed)
        assert run(ALICE, legs, *self.precompute(store))[0] == 0
        code, said = run(ALICE, legs, *self.precompute(store, "-r", 2)[:-3], 2, "-r", 2)
        assert (code, "the current folder is another user's" in said) == (2, True), said
