"""legs-patch on real folders: all files or none are written, undo restores them, and the folders that it reads."""

from __future__ import annotations

import json
import os
import sys

import pytest
from legs_adapters.checkout import replace as replace_module
from legs_adapters.code.folders import walk, why_left_out
from legs_adapters.code.sources import Source, decode
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan, write
from legs_adapters.runner import checkout_of
from legs_adapters.undo import undo

from legs_loss import LegsError
from tests.patcher.support import checkout, files, run_git, snapshot


def patched(root, **options):
    write(plan(root, **options))
    return root


class TestWriting:
    def test_a_second_run_changes_nothing(self, tmp_path):
        root = patched(checkout(tmp_path, files("decoupled_appearance_weighted")))
        before = snapshot(root)
        assert write(plan(root)) == []
        assert snapshot(root) == before

    def test_a_site_added_later_is_undone_with_the_first(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        before = snapshot(root)
        patched(root)
        text = files("inria")["train.py"].splitlines()
        line = text.index("            l1_test += l1_loss(image, gt_image).mean().double()") + 2
        patched(root, by_hand=[("train.py", line)])
        assert (root / "train.py").read_text().count("= legs_loss.l1_loss") == 3  # one of them a comment
        undo(root)
        assert snapshot(root) == before

    def test_all_or_nothing_across_files(self, tmp_path, monkeypatch):
        root = checkout(tmp_path, files("gui_train_step_weighted"))
        before = snapshot(root)
        replace, calls = os.replace, []

        def fail_at_the_third(source, target, **folders):
            calls.append(target)
            if len(calls) == 3:
                raise OSError(28, "No space left on device", target)
            replace(source, target, **folders)

        monkeypatch.setattr(replace_module.os, "replace", fail_at_the_third)
        with pytest.raises(LegsError, match="No space left on device; nothing was changed"):
            write(plan(root))
        assert snapshot(root) == before

    def test_a_file_that_changed_meanwhile_stops_it(self, tmp_path):
        root = checkout(tmp_path, files("gui_train_step_weighted"))
        found = plan(root)
        (root / "train_gui.py").write_text("# mine\n")
        before = snapshot(root)
        with pytest.raises(LegsError, match="changed while legs-patch was running"):
            write(found)
        assert snapshot(root) == before

    def test_an_interrupted_write_can_be_taken_back(self, tmp_path, monkeypatch):
        root = checkout(tmp_path, files("gui_train_step_weighted"))
        before = snapshot(root)
        replace, calls = os.replace, []

        def killed_at_the_third(source, target, **folders):
            calls.append(target)
            if len(calls) == 3:
                os._exit(9)
            replace(source, target, **folders)

        child = os.fork()
        if child == 0:
            os.replace = killed_at_the_third
            write(plan(root))
            os._exit(0)
        assert os.waitpid(child, 0)[1] >> 8 == 9
        assert (root / JOURNAL).exists()
        undo(root)
        assert snapshot(root) == before

    def test_permissions_stay(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        (root / "train.py").chmod(0o755)
        patched(root)
        assert (root / "train.py").stat().st_mode & 0o777 == 0o755
        undo(root)
        assert (root / "train.py").stat().st_mode & 0o777 == 0o755


class TestUndo:
    def test_a_file_that_was_edited_since_is_refused(self, tmp_path):
        root = patched(checkout(tmp_path, files("inria")))
        (root / "train.py").write_text((root / "train.py").read_text() + "# mine\n")
        before = snapshot(root)
        with pytest.raises(LegsError, match=r"train\.py: edited since it was patched"):
            undo(root)
        assert snapshot(root) == before

    def test_force_puts_the_patch_s_lines_back_and_leaves_the_edits(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        original = (root / "train.py").read_text()
        patched(root)
        edited = (root / "train.py").read_text()
        edited = edited.replace("        loss.backward()\n", "        loss = 2 * loss\n        loss.backward()\n")
        (root / "train.py").write_text("# mine\n" + edited)
        changes, kept = undo(root, force=True)
        assert changes["train.py"][1] == (root / "train.py").read_bytes()
        assert (list(changes), kept) == (["train.py"], [])
        assert (root / "train.py").read_text() == "# mine\n" + original.replace(
            "        loss.backward()\n", "        loss = 2 * loss\n        loss.backward()\n"
        )
        assert not (root / JOURNAL).exists()

    def test_force_says_which_of_its_lines_are_no_longer_its_own(self, tmp_path):
        root = patched(checkout(tmp_path, files("inria")))
        text = (root / "train.py").read_text().replace("l1_loss(image, gt_image)", "l1_loss(gt_image, image)")
        (root / "train.py").write_text(text)
        _, kept = undo(root, force=True)
        assert [name for name, _ in kept] == ["train.py"]
        assert "legs_loss.l1_loss" in kept[0][1]
        assert (root / "train.py").read_text() == text  # with the import, which that line needs

    def test_legs_toml_is_removed_unless_it_was_edited(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        write(plan(root)._replace(settings="beta = 2.0\n"))
        assert undo(root)[0]["legs.toml"] == (b"beta = 2.0\n", None)
        write(plan(root)._replace(settings="beta = 2.0\n"))
        (root / "legs.toml").write_text("beta = 3.0\n")
        assert undo(root)[1] == [("legs.toml", "it was edited since")]
        assert (root / "legs.toml").read_text() == "beta = 3.0\n"

    def test_what_git_took_back_already_is_fine(self, tmp_path):
        root = checkout(tmp_path, files("inria"), git=True)
        before = snapshot(root)
        patched(root)
        run_git(root, "checkout", "-q", "--", ".")
        undo(root)
        assert snapshot(root) == before

    def test_without_a_patch_there_is_nothing_to_take_back(self, tmp_path):
        with pytest.raises(LegsError, match="nothing to undo"):
            undo(tmp_path)

    def test_a_damaged_or_hostile_journal_writes_nothing_outside(self, tmp_path):
        root = patched(checkout(tmp_path / "repo", files("inria")))
        content = json.loads((root / JOURNAL).read_text())
        content["files"] = {"../outside.py": content["files"]["train.py"]}
        (root / JOURNAL).write_text(json.dumps(content))
        (tmp_path / "outside.py").write_text("mine\n")
        with pytest.raises(LegsError, match="not the path of a file in the checkout"):
            undo(root)
        assert (tmp_path / "outside.py").read_text() == "mine\n"


class TestWhereItLooks:
    def test_not_in_what_is_not_the_checkout_s_own(self, tmp_path):
        foreign = [
            ".git/hooks/train.py",
            "submodules/other/train.py",
            "sub/module/train.py",
            "venv/lib/train.py",
            "my_env/train.py",
            "worktree/train.py",
            "modules/train.py",
            "tests/test_train.py",
            "test_train.py",
            "third_party/train.py",
            "__pycache__/train.py",
            "scripts/.ipynb_checkpoints/train-checkpoint.py",
        ]
        root = checkout(tmp_path, {name: "x = 1\n" for name in [*foreign, "train.py", "scripts/train.py"]})
        (root / ".gitmodules").write_text('[submodule "m"]\n\tpath = sub/module\n\turl = x\n')
        (root / "my_env" / "pyvenv.cfg").write_text("")
        (root / "worktree" / ".git").write_text(f"gitdir: {root}/.git/worktrees/worktree\n")
        (root / "modules" / ".git").write_text("gitdir: ../.git/modules/modules\n")
        assert list(walk(root)) == ["train.py", "scripts/train.py"]

    def test_a_nested_checkout_belongs_to_it_and_its_own_submodules_do_not(self, tmp_path):
        texts = {"nested/.git/config": "", "nested/.gitmodules": "[submodule]\n\tpath = part\n", "nested/part/a.py": ""}
        root = checkout(tmp_path, {"train.py": "", "nested/loss.py": "", "kept/loss.py": "", **texts})
        (root / "kept" / ".git").write_text("gitdir: /elsewhere/modules/kept.git\n")  # git clone --separate-git-dir
        assert sorted(walk(root)) == ["kept/loss.py", "nested/loss.py", "train.py"]
        assert why_left_out(root, "nested/part/a.py") == (
            "nested/part is not searched (a submodule): run legs-patch on that folder"
        )

    @pytest.mark.parametrize(
        ("script", "root"),
        [
            ("scripts/train.py", "."),
            ("tests/train.py", "."),
            ("third_party/gaussian-splatting/tools/train.py", "third_party/gaussian-splatting"),
            ("sub/module/train.py", "sub/module"),
        ],
    )
    def test_what_is_run_is_looked_at_where_it_is(self, script, root, tmp_path):
        folder = checkout(
            tmp_path, {".git/config": "", script: "", ".gitmodules": "[submodule]\n\tpath = sub/module\n"}
        )
        assert checkout_of(folder / script) == (folder / root).resolve()

    @pytest.mark.skipif(sys.platform == "win32", reason="links want a privilege there")
    def test_links_are_not_followed(self, tmp_path):
        outside = checkout(tmp_path / "outside", files("inria"))
        root = checkout(tmp_path / "repo", {**files("gui_train_step_weighted")})
        (root / "linked").symlink_to(outside, target_is_directory=True)
        (root / "linked.py").symlink_to(outside / "train.py")
        before = snapshot(outside)
        patched(root)
        assert snapshot(outside) == before
        assert "linked.py" not in list(walk(root))

    def test_a_link_that_appears_between_plan_and_write_is_not_followed(self, tmp_path):
        root = checkout(tmp_path / "repo", files("inria"))
        found = plan(root)
        outside = tmp_path / "outside.py"
        outside.write_bytes((root / "train.py").read_bytes())
        (root / "train.py").unlink()
        (root / "train.py").symlink_to(outside)
        before = outside.read_bytes()
        with pytest.raises(LegsError, match="is a link"):
            write(found)
        assert outside.read_bytes() == before

    def test_globs_leave_files_and_folders_out(self, tmp_path):
        root = checkout(tmp_path, {"a.py": "", "old/b.py": "", "new/old/c.py": "", "new/d_old.py": ""})
        assert list(walk(root, ["old"])) == ["a.py", "new/d_old.py"]
        assert list(walk(root, ["*_old.py", "new/*"])) == ["a.py", "old/b.py"]

    @pytest.mark.parametrize(
        ("data", "reason"),
        [
            (b"print 'hello'\n", "does not parse (line 1: "),
            (b"def f(:\n", "does not parse (line 1: "),
            (
                b"class A:\n    def f(self):\n\tx = l1(1)\n",
                "does not parse (line 3: inconsistent use of tabs and spaces in indentation; Python 3.",
            ),
            (b"# -*- coding: latin-1 -*-\nx = '\xe9'\n", "not UTF-8 (byte 31)"),
            (b"x = '\xe9'\n", "not UTF-8 (byte 5)"),
        ],
    )
    def test_files_that_cannot_be_read_are_reported_and_not_fatal(self, data, reason, tmp_path):
        root = checkout(tmp_path, files("inria"))
        (root / "old_loss.py").write_bytes(data if b"coding" in data else data + b"# loss.backward() l1_loss\n")
        found = plan(root)
        [entry] = found.findings.unreadable
        assert (entry.path, entry.reason[: len(reason)]) == ("old_loss.py", reason)
        assert list(found.after) == ["train.py"]

    @pytest.mark.parametrize(
        "text",
        [
            "def first():\n\treturn 1\n\n\ndef step(image, gt):\n    l1_loss(image, gt).backward()\n",
            "def step(image, gt):\n    if image:\n    \tl1_loss(image, gt).backward()\n    return 1\n",
            "class A:\n\tdef step(self, image, gt):\n        # blanks\n\t    l1_loss(image, gt).backward()\n",
            "def step(image, gt):\n    l1_loss(\n\t\timage, gt).backward()\n\t\n    return 1\n",
        ],
    )
    def test_tabs_and_blanks_that_python_reads_are_read(self, text, tmp_path):
        texts = {**files("inria"), "other.py": "# splats\nfrom utils.loss_utils import l1_loss\n" + text}
        compile(texts["other.py"], "other.py", "exec")
        found = plan(checkout(tmp_path, texts)).findings
        assert found.unreadable == []
        assert "other.py" in [entry.path for entry in [*found.sites, *found.left, *found.doubts]]

    def test_a_notebook_that_trains_is_named(self, tmp_path):
        root = checkout(tmp_path, {**files("inria"), "a.ipynb": "loss.backward()", "b.ipynb": "plot()"})
        found = plan(root)
        assert [entry.path for entry in found.findings.unreadable] == ["a.ipynb"]
        assert list(found.after) == ["train.py"]

    def test_decoding_says_what_python_would(self):
        assert isinstance(decode("a.py", b"# vim: set fileencoding=utf-8 :\n"), Source)
        assert decode("a.py", b"\xef\xbb\xbfx = 1\n").text == "x = 1\n"
