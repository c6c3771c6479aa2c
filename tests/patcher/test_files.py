"""legs-patch on real folders: what it writes, that it takes back every byte, and what it never touches."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import textwrap

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from legs_adapters.checkout import replace as replace_module
from legs_adapters.cli import main
from legs_adapters.code.folders import walk
from legs_adapters.code.sources import Source, decode
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan, write
from legs_adapters.runner import checkout_of
from legs_adapters.undo import undo

from legs_loss import LegsError
from tests.patcher.support import NAMES, checkout, expected, files, legs_patch, run_git, snapshot
from tests.support import ROOT

SITE = "        Ll1 = l1_loss(image, gt_image)\n"
PATCHED = "        Ll1 = legs_loss.l1_loss(image, gt_image, view=viewpoint_cam.image_name)\n"
ONE_FILE = textwrap.dedent(
    """\
    import torch
    from utils.loss_utils import l1_loss
    from gaussian_renderer import render


    def training(scene, gaussians):
        for viewpoint_cam in scene:
            image = render(viewpoint_cam, gaussians, None, None)["render"]
            gt_image = viewpoint_cam.original_image.cuda()
            SITE
            Ll1.backward()
    """
)


def patched(root, **options):
    write(plan(root, **options))
    return root


WEIGHTED = [name for name in NAMES if "weighted" in dict(expected(files(name)).values())]


@pytest.mark.parametrize("name", WEIGHTED)
def test_undo_gives_back_every_byte(name, tmp_path):
    root = checkout(tmp_path, files(name))
    before = snapshot(root)
    assert write(plan(root))
    assert snapshot(root) != before
    undo(root)
    assert snapshot(root) == before


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.rstrip("\n"),
        lambda text: "\ufeff" + text,
        lambda text: "\ufeff" + text.replace("\n", "\r\n").rstrip(),
        lambda text: text.replace("    for", "\tfor").replace("        ", "\t\t"),
        lambda text: "# -*- coding: utf-8 -*-\n# Größe\n" + text,
        lambda text: text.replace("import torch\n", "import os; import torch  # für alle\f\n"),
        lambda text: text + "\n\n\x0c\n# the end\n\n\n",
    ],
    ids=["crlf", "no final newline", "bom", "bom, crlf, no newline", "tabs", "coding", "semicolons", "form feed"],
)
def test_bytes_that_are_not_the_edit_stay(change, tmp_path):
    data = change(ONE_FILE.replace("        SITE\n", SITE)).encode("utf-8")
    root = checkout(tmp_path, {**files("inria"), "train.py": data})
    found = plan(root)
    (path, after), newline = next(iter(found.after.items())), b"\r\n" if b"\r\n" in data else b"\n"
    for edit in sorted(found.edits[path], reverse=True):
        assert after.count(edit.after) >= 1
    assert after.startswith(b"\xef\xbb\xbf") == data.startswith(b"\xef\xbb\xbf")
    assert after.count(newline) == data.count(newline) + 1
    assert after.endswith(data[-10:])
    removed = after.replace(b"import legs_loss" + newline, b"", 1)
    wanted = data.replace(b"Ll1 = l1_loss(image, gt_image)", PATCHED.strip().encode(), 1)
    assert removed == wanted
    write(found)
    undo(root)
    assert (root / "train.py").read_bytes() == data


SPACES = st.sampled_from(["", " ", "  ", "\n                ", "  # why\n            ", " \\\n            "])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(SPACES, min_size=6, max_size=6),
    st.sampled_from(["call", "keyword", "abs", "method", "mean", "masked"]),
    st.sampled_from(['"', "'"]),
    st.sampled_from(["\n", "\r\n"]),
    st.booleans(),
)
@example(["\n", "  # why\n            ", "", "", " \\\n            ", ""], "abs", '"', "\r\n", True)
def test_formatting_makes_no_difference(tmp_path, spaces, form, quote, newline, comma):
    a, b, c, d, e, f = (" " if "\n" not in s and "\\" in s else s for s in spaces)
    image, gt = f"pkg[{quote}render{quote}]", "viewpoint_cam.original_image"
    tail = "," if comma else ""
    expressions = {
        "call": f"l1_loss({a}{image}{b},{c}{gt}{d}{tail}{e})",
        "keyword": f"l1_loss({a}network_output={image}{b},{c}gt={gt}{d}{tail}{e})",
        "abs": f"torch.abs({a}{image}{b}-{c}{gt}{d}).mean({e})",
        "method": f"({a}{image}{b}-{c}{gt}{d}).abs({e}).mean({f})",
        "mean": f"torch.mean({a}torch.abs({b}({c}{gt}{d}-{e}{image}{f})))",
        "masked": f"l1_loss({a}{image}[mask]{b},{c}{gt}[mask]{d}{tail}{e})",
    }
    text = ONE_FILE.replace(
        'image = render(viewpoint_cam, gaussians, None, None)["render"]', "pkg = render(viewpoint_cam)"
    )
    text = text.replace("        SITE\n", f"        Ll1 = {expressions[form]}{'' if comma else '  # the term'}\n")
    data = text.replace("\n", newline).encode()
    root = checkout(tmp_path / f"{abs(hash((form, data)))}", {**files("inria"), "train.py": data})
    found = plan(root)
    assert [site.path for site in found.findings.sites] == ["train.py"]
    after = found.after["train.py"]
    namespace = compile(after, "train.py", "exec")
    assert namespace
    here = plan(root, in_place=True).after["train.py"]
    assert here.count(b"\n") == data.count(b"\n")
    assert after.count(b"#") == data.count(b"#"), "a comment was lost"
    call = "".join(after.decode().split("legs_loss.l1_loss(", 1)[1].split("Ll1.backward")[0].split())
    assert call.index("render") < call.index("original_image"), "the rendering comes first"
    assert "view=viewpoint_cam.image_name" in call
    write(found)
    undo(root)
    assert (root / "train.py").read_bytes() == data


STATEMENTS = st.sampled_from(
    [
        "x = 1\n",
        "import os\n",
        "from __future__ import annotations\n",
        '"""A text."""\n',
        "def f(a, b):\n    return abs(a - b)\n",
        "class A:\n    def l1_loss(self, image, gt_image):\n        return (image - gt_image).abs().mean()\n",
        "def g(render, cam):\n    image = render(cam)['render']\n    l1_loss(image, cam.original_image).backward()\n",
        "def h(m, gaussians):\n    torch.nn.functional.l1_loss(m.render, m.gt_image, reduction='sum').backward()\n",
        "with open('x') as f:\n    pass\n",
        "# only a comment\n",
        "\n",
        "try:\n    import torch\nexcept ImportError:\n    torch = None\n",
        "print('ü', *[i for i in range(3)], sep='\\n')\n",
    ]
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(STATEMENTS, max_size=8), st.sampled_from(["", "\n"]), st.sampled_from(["\n", "\r\n", "\r"]))
def test_undo_of_a_patch_is_the_file_whatever_the_file(tmp_path, statements, ending, newline):
    future = [text for text in statements if "__future__" in text][:1]
    text = "".join([*future, *(text for text in statements if "__future__" not in text)]).rstrip("\n") + ending
    data = text.replace("\n", newline).encode("utf-8")
    root = checkout(tmp_path / f"{abs(hash(data))}", {"train.py": data})
    found = plan(root)
    if found.after:
        compile(found.after["train.py"], "train.py", "exec")
        write(found)
        undo(root)
    assert (root / "train.py").read_bytes() == data
    assert snapshot(root) == {"train.py": data}


class TestWriting:
    def test_a_second_run_changes_nothing(self, tmp_path):
        root = patched(checkout(tmp_path, files("appearance")))
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
        root = checkout(tmp_path, files("gui"))
        before = snapshot(root)
        replace, calls = os.replace, []

        def fail_at_the_third(source, target):
            calls.append(target)
            if len(calls) == 3:
                raise OSError(28, "No space left on device", target)
            replace(source, target)

        monkeypatch.setattr(replace_module.os, "replace", fail_at_the_third)
        with pytest.raises(LegsError, match="No space left on device; nothing was changed"):
            write(plan(root))
        assert snapshot(root) == before

    def test_a_file_that_changed_meanwhile_stops_it(self, tmp_path):
        root = checkout(tmp_path, files("gui"))
        found = plan(root)
        (root / "train_gui.py").write_text("# mine\n")
        before = snapshot(root)
        with pytest.raises(LegsError, match="changed while legs-patch was at work"):
            write(found)
        assert snapshot(root) == before

    def test_an_interrupted_write_can_be_taken_back(self, tmp_path, monkeypatch):
        root = checkout(tmp_path, files("gui"))
        before = snapshot(root)
        replace, calls = os.replace, []

        def killed_at_the_third(source, target):
            calls.append(target)
            if len(calls) == 3:
                os._exit(9)
            replace(source, target)

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
        done = undo(root, force=True)
        assert done.restored == ["train.py"]
        assert done.kept == []
        assert (root / "train.py").read_text() == "# mine\n" + original.replace(
            "        loss.backward()\n", "        loss = 2 * loss\n        loss.backward()\n"
        )
        assert not (root / JOURNAL).exists()

    def test_force_says_which_of_its_lines_are_no_longer_its_own(self, tmp_path):
        root = patched(checkout(tmp_path, files("inria")))
        text = (root / "train.py").read_text().replace("view=viewpoint_cam.image_name", "view=None")
        (root / "train.py").write_text(text)
        done = undo(root, force=True)
        assert [name for name, _ in done.kept] == ["train.py"]
        assert "legs_loss.l1_loss" in done.kept[0][1]
        assert "view=None" in (root / "train.py").read_text()

    def test_legs_toml_is_removed_unless_it_was_edited(self, tmp_path):
        root = checkout(tmp_path, files("inria"))
        write(plan(root)._replace(settings="beta = 2.0\n"))
        assert undo(root).removed == ["legs.toml"]
        write(plan(root)._replace(settings="beta = 2.0\n"))
        (root / "legs.toml").write_text("beta = 3.0\n")
        assert undo(root).kept == [("legs.toml", "it was edited since: yours now")]
        assert (root / "legs.toml").read_text() == "beta = 3.0\n"

    def test_what_git_took_back_already_is_fine(self, tmp_path):
        root = checkout(tmp_path, files("inria"), git=True)
        before = snapshot(root)
        patched(root)
        run_git(root, "checkout", "-q", "--", ".")
        undo(root)
        assert snapshot(root) == before

    def test_without_a_patch_there_is_nothing_to_take_back(self, tmp_path):
        with pytest.raises(LegsError, match="nothing to take back"):
            undo(tmp_path)

    def test_a_damaged_or_hostile_journal_writes_nothing_outside(self, tmp_path):
        root = patched(checkout(tmp_path / "repo", files("inria")))
        content = json.loads((root / JOURNAL).read_text())
        content["files"] = {"../outside.py": content["files"]["train.py"]}
        (root / JOURNAL).write_text(json.dumps(content))
        (tmp_path / "outside.py").write_text("mine\n")
        with pytest.raises(LegsError, match="no path of a file in the checkout"):
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
            "nested_checkout/train.py",
            "tests/test_train.py",
            "test_train.py",
            "third_party/train.py",
            "__pycache__/train.py",
            "scripts/.ipynb_checkpoints/train-checkpoint.py",
        ]
        root = checkout(tmp_path, {name: "x = 1\n" for name in [*foreign, "train.py", "scripts/train.py"]})
        (root / ".gitmodules").write_text('[submodule "m"]\n\tpath = sub/module\n\turl = x\n')
        (root / "my_env" / "pyvenv.cfg").write_text("")
        (root / "nested_checkout" / ".git").write_text("gitdir: elsewhere\n")
        assert list(walk(root)) == ["train.py", "scripts/train.py"]

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
        root = checkout(tmp_path / "repo", {**files("gui")})
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
            (b"print 'hello'\n", "Python 2"),
            (b"def f(:\n", "does not parse (line 2)"),
            (b"# -*- coding: latin-1 -*-\nx = '\xe9'\n", "not UTF-8 (it declares latin-1)"),
            (b"x = '\xe9'\n", "not UTF-8 (byte 5)"),
        ],
    )
    def test_files_that_cannot_be_read_are_reported_and_not_fatal(self, data, reason, tmp_path):
        root = checkout(tmp_path, files("inria"))
        (root / "old_loss.py").write_bytes(data if b"coding" in data else data + b"# loss.backward() l1_loss\n")
        found = plan(root)
        assert [(entry.path, entry.reason) for entry in found.findings.unreadable] == [("old_loss.py", reason)]
        assert list(found.after) == ["train.py"]

    def test_decoding_says_what_python_would(self):
        assert isinstance(decode("a.py", b"# vim: set fileencoding=utf-8 :\n"), Source)
        assert decode("a.py", b"\xef\xbb\xbfx = 1\n").text == "x = 1\n"


@pytest.fixture
def run(capsys):
    """Run legs-patch in this process: (exit code, stdout, stderr). Starting one costs seconds, most of them torch's."""

    def call(*arguments):
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, code, out, err)

    return call


class TestCommandLine:
    def test_patch_check_diff_undo(self, tmp_path):
        root = checkout(tmp_path, files("inria"), git=True)
        before = snapshot(root)
        diff = legs_patch("--diff", root)
        assert diff.returncode == 0
        assert "-" + SITE in diff.stdout
        assert "+" + PATCHED in diff.stdout
        assert "+import legs_loss\n" in diff.stdout
        assert "\033[" not in diff.stdout
        assert legs_patch("--check", root).returncode == 1
        assert snapshot(root) == before

        done = legs_patch(root, "--preset", "legs-l", "--beta", "4")
        assert done.returncode == 0, done.stderr
        assert (
            "patched               view=viewpoint_cam.image_name: viewpoint_cam.original_image, untouched\n"
            in done.stdout
        )
        assert "legs-patch --undo" in done.stdout
        assert 'preset = "legs-l"' in (root / "legs.toml").read_text()
        assert "\nbeta = 4.0" in (root / "legs.toml").read_text()

        again = legs_patch(root)
        assert (again.returncode, legs_patch("--check", root).returncode) == (0, 0)
        assert "nothing to do" in again.stdout

        undone = legs_patch("--undo", root)
        assert undone.returncode == 0
        assert "restored train.py" in undone.stdout
        assert snapshot(root) == before

    def test_the_settings_reach_the_run(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        done = run(root, "--curve", "C5", "--operator", "sobel", "--beta", "2.5", "--store", root / "maps")
        assert done.returncode == 0, done.stderr
        from legs_loss.config import find_config

        config = find_config(root / "train.py", environ={}, argv=[])
        assert (config.spec.curve, config.spec.operator, config.spec.beta) == ("C5", "sobel", 2.5)
        assert config.store == root / "maps"
        assert find_config(root / "train.py", environ={"LEGS_BETA": "7"}, argv=[]).spec.beta == 7.0

    def test_a_dirty_tree_is_refused_and_a_dry_run_is_not(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"), git=True)
        (root / "scene" / "cameras.py").write_text("# mine\n" + files("inria")["scene/cameras.py"])
        before = snapshot(root)
        refused = run(root)
        assert refused.returncode == 2
        assert "uncommitted changes (scene/cameras.py)" in refused.stderr
        assert snapshot(root) == before
        assert run("--diff", root).returncode == 0
        assert run("--force", root).returncode == 0

    def test_what_cannot_be_decided_stops_it_unless_partial(self, tmp_path, run):
        root = checkout(tmp_path, files("undecided"))
        before = snapshot(root)
        refused = run(root)
        assert refused.returncode == 2
        assert "train.py:11: cannot tell which of image_a and image_b" in refused.stderr
        assert "loss = loss + l1_loss(image_a, image_b)" in refused.stderr
        assert "write there: legs_loss.l1_loss(image_a, image_b)" in refused.stderr
        assert snapshot(root) == before
        assert run("--diff", "--partial", root).returncode == 1
        partial = run("--partial", root)
        assert partial.returncode == 1
        assert "legs_loss.l1_loss(image, cam.original_image, view=cam.image_name)" in (root / "train.py").read_text()
        assert "l1_loss(image_a, image_b)" in (root / "train.py").read_text()

    def test_partial_does_not_call_a_tree_patched_of_which_nothing_could_be_decided(self, tmp_path, run):
        texts = files("kernel")
        root = checkout(tmp_path, texts)
        before = snapshot(root)
        partial = run("--partial", root)
        assert partial.returncode == 1
        assert "nothing could be decided" in partial.stdout
        assert "legs-patch: error: " in partial.stderr
        assert snapshot(root) == before

    def test_json(self, tmp_path, run):
        root = checkout(tmp_path, files("channels_last"))
        done = run("--json", "--check", root)
        content = json.loads(done.stdout)
        assert done.returncode == 1
        found = [(s["line"], s["channels_last"]) for s in content["sites"] if s["file"] == "simple_trainer.py"]
        assert found[:4] == [(16, True), (19, True), (25, True), (39, True)]
        assert content["left"][0]["reason"] == "definition" or content["left"][0]["reason"] == "depth"
        assert "simple_trainer.py" in content["would_change"]
        assert content["wrote"] == []

    def test_calls_that_stay_plain_are_reported_and_undone(self, tmp_path, run):
        root = checkout(tmp_path, files("bodies_of_two"))
        before = snapshot(root)
        content = json.loads(run("--json", root).stdout)
        assert [(plain["file"], plain["line"], plain["reason"]) for plain in content["plain"]] == [
            ("blurry.py", 14, "distillation"),
            ("avatar.py", 15, "distillation"),
            ("train.py", 15, "distillation"),
            ("train.py", 17, "distillation"),
            ("train.py", 23, "depth"),
            ("slam.py", 7, "tracking"),
        ]
        assert content["plain"][0]["weighted_at"] == "blurry.py:8"
        assert "slam.py" in content["wrote"]
        again = run(root)
        assert "nothing to do: it is patched" in again.stdout
        assert "slam.py:8                already patched\n" in again.stdout
        assert run("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_calls_of_a_body_chosen_by_hand_stay_plain_too(self, tmp_path, run):
        root = checkout(tmp_path, files("bodies_of_two"))
        done = run("--site", "utils/photometric.py:17", root)
        assert done.returncode == 0, done.stderr
        assert "legs_loss.unweighted(rgb_loss)(" in (root / "slam.py").read_text()
        assert "import legs_loss" not in (root / "train.py").read_text()

    @pytest.mark.parametrize(
        ("line", "arguments"),
        [
            (b"    return rgb_loss(a, b)\n", ["--exclude", "old"]),
            (b"    print 'of old', rgb_loss(a, b)\n", []),
            (b"    return rgb_loss(a, b)  # \xe9\n", []),
        ],
        ids=["excluded", "Python 2", "not UTF-8"],
    )
    def test_a_call_in_a_file_that_is_not_read_is_an_error(self, line, arguments, tmp_path, run):
        texts = files("bodies_of_two")
        texts["old/slam.py"] = b"from utils.photometric import rgb_loss\n\n\ndef old(a, b):\n" + line
        root = checkout(tmp_path, texts)
        before = snapshot(root)
        done = run(*arguments, root)
        assert done.returncode == 2
        assert "rgb_loss also serves tracking at slam.py:7; what it serves at old/slam.py cannot be told" in done.stderr
        assert snapshot(root) == before

    def test_a_site_by_hand(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        done = run("--site", "train.py:44", root)
        assert done.returncode == 0, done.stderr
        assert "l1_test += legs_loss.l1_loss(image, gt_image" in (root / "train.py").read_text()
        missing = run("--site", "train.py:3", root)
        assert missing.returncode == 2
        assert "there is no L1 term at train.py:3" in missing.stderr

    def test_a_function_that_is_settled_at_run_time_is_weighted_by_hand(self, tmp_path, run):
        root = checkout(tmp_path, files("settled_at_run_time"))
        before = snapshot(root)
        line = (
            files("settled_at_run_time")["train.py"].splitlines().index("        loss1 = loss_func(image, gt_image)")
            + 1
        )
        done = run("--site", f"train.py:{line}", root)
        assert done.returncode == 0, done.stderr
        text = (root / "train.py").read_text()
        assert "loss1 = legs_loss.l1_loss(image, gt_image, view=cam.image_name, own=loss_func)\n" in text
        assert text.count("own=") == 1
        assert run("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_folders_that_are_not_entered_are_named_where_nothing_was_found(self, tmp_path, run):
        vendored = {f"third_party/gaussian-splatting/{path}": text for path, text in files("inria").items()}
        mentions = {path: "from losses import l1_loss\n" for path in ("extern/a/x.py", "tests/x.py", "venv/x.py")}
        others = {"third_party/simple-knn/setup.py": "", "extern/deeper/third_party/b/x.py": "F.l1_loss\n"}
        root = checkout(tmp_path, {"run.py": "import os\n", **vendored})
        (root / "third_party" / "gaussian-splatting" / ".git").write_text("gitdir: elsewhere\n")
        found = run(root)
        assert (found.returncode, found.stderr.count("\n")) == (2, 1)
        named = "third_party/gaussian-splatting (a checkout of its own)"
        assert found.stderr.endswith(f"; not looked into: {named}: run legs-patch on that folder\n")
        assert "not looked into" not in run(root, "--exclude", "third_party").stderr
        checkout(root, {**mentions, **others})
        assert run(root).stderr.endswith(
            f"; not looked into: {named}, extern/a (other people's code), "
            "extern/deeper/third_party/b (other people's code) and 1 more: run legs-patch on the one that trains\n"
        )
        assert run(root / "third_party" / "gaussian-splatting").returncode == 0

    @pytest.mark.parametrize(
        ("path", "message"),
        [
            (
                "third_party/gs/train.py",
                "third_party/gs is not looked into (a submodule): run legs-patch on that folder",
            ),
            (
                "third_party/train.py",
                "third_party is not looked into (other people's code): run legs-patch on that folder",
            ),
            ("a/extern/b/c/train.py", "a/extern/b is not looked into (other people's code): run legs-patch"),
            ("my_env/train.py", "my_env is not looked into (a virtual environment)\n"),
            ("old/train.py", "--exclude leaves it out"),
            ("test_train.py", "tests are not looked into"),
            ("train.sh", "it is no .py file"),
            ("broken.py", "does not parse (line 1)"),
        ],
    )
    def test_a_site_that_is_not_looked_into_is_said_to_be(self, path, message, tmp_path, run):
        root = checkout(tmp_path, {"my_env/pyvenv.cfg": "", path: "l1_loss(image, gt_image) loss.backward()\n"})
        (root / ".gitmodules").write_text('[submodule "gs"]\n\tpath = third_party/gs\n')
        refused = run(root, "--site", f"{path}:1", "--exclude", "old")
        assert refused.returncode == 2
        assert f"legs-patch: error: {path}:1: {message}" in refused.stderr

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["nowhere"], "nowhere does not exist"),
            (["empty", "--beta", "-1"], "beta"),
            (["empty", "--curve", "C9"], "C9"),
            (["empty", "--preset", "best"], "no preset is named 'best'"),
            (["empty"], "no photometric L1 term was found"),
            (["empty", "--undo"], "nothing to take back"),
            (["empty", "--site", "train.py"], "--site wants FILE:LINE"),
        ],
    )
    def test_bad_usage_is_one_line(self, arguments, message, tmp_path, run, monkeypatch):
        (tmp_path / "empty").mkdir()
        monkeypatch.chdir(tmp_path)
        done = run(*arguments)
        assert done.returncode == 2
        assert done.stderr.startswith("legs-patch: error: ")
        assert message in done.stderr
        assert done.stderr.count("\n") == 1

    def test_a_legs_toml_of_the_user_s_stays(self, tmp_path, run):
        root = checkout(tmp_path, {**files("inria"), "legs.toml": "beta = 3.0\n"})
        assert run(root).returncode == 0
        assert (root / "legs.toml").read_text() == "beta = 3.0\n"
        refused = run(root, "--beta", "5")
        assert refused.returncode == 2
        assert "legs.toml is there already" in refused.stderr
        assert run("--undo", root).returncode == 0
        assert (root / "legs.toml").read_text() == "beta = 3.0\n"


def test_the_pre_commit_hook_fails_until_the_checkout_is_patched(tmp_path):
    hook = dict(re.findall(r"^[- ] (\w+): (.*)$", (ROOT / ".pre-commit-hooks.yaml").read_text(encoding="utf-8"), re.M))
    assert hook["id"] == "legs-patch-check" and hook["pass_filenames"] == "false"
    program, *arguments = hook["entry"].split()
    assert program == "legs-patch"
    root = checkout(tmp_path / "fork", files("inria"), git=True)
    assert legs_patch(*arguments, cwd=str(root)).returncode == 1
    assert legs_patch(".", cwd=str(root)).returncode == 0
    done = legs_patch(*arguments, cwd=str(root))
    assert done.returncode == 0, done.stdout + done.stderr
