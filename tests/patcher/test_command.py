"""The command legs-patch: options, exit codes, reports; and the pre-commit hook."""

from __future__ import annotations

import json
import os
import re
import subprocess

import pytest
from legs_adapters.cli import main
from legs_adapters.plan import plan
from legs_adapters.terms.instead import trained_instead

from legs_loss.config import find_config
from tests.patcher.support import PATCHED, SITE, checkout, files, legs_patch, run_git, snapshot, without_marks
from tests.support import ROOT


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
        rows = legs_patch("--check", root).stdout.partition("would change")[0]
        assert rows in diff.stderr
        assert "train.py:32            skipped  No backward pass was found that reaches it, and it is under" in rows
        assert legs_patch("--check", root).returncode == 1
        assert snapshot(root) == before

        done = legs_patch(root, "--preset", "legs-l", "--beta", "4")
        assert done.returncode == 0, done.stderr
        assert "patched  gt_image is the photograph\n" in done.stdout
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

    def test_the_documents_show_the_real_diff_and_report(self, tmp_path, run):
        texts = {path: without_marks(text) for path, text in files("runnable_train_script_weighted").items()}
        texts["train.py"] = texts["train.py"].partition("\n")[2]  # the line that says whose script it is
        root = checkout(tmp_path / "my_gs", texts)
        page = (ROOT / "docs" / "patching.md").read_text(encoding="utf-8")
        diff = "\n".join(line.rstrip() for line in run("--diff", root).stdout.splitlines())
        assert f"$ legs-patch --diff my_gs\n{diff}\n```" in page
        report = run("--check", root).stdout.partition("would change")[0]
        assert f"$ legs-patch my_gs\n{report}" in page

    def test_the_documents_show_the_real_line_of_the_start(self, tmp_path, monkeypatch, capsys):
        import torch

        from legs_loss import l1_loss
        from tests.support import start_run

        start_run(monkeypatch, tmp_path)
        l1_loss(torch.rand(3, 8, 8, requires_grad=True), torch.rand(3, 8, 8))
        (line,) = capsys.readouterr().err.splitlines()
        assert f"\n{line}\n" in (ROOT / "docs" / "patching.md").read_text(encoding="utf-8")

    def test_the_settings_reach_the_run(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        done = run(root, "--curve", "C5", "--operator", "sobel", "--beta", "2.5", "--store", root / "maps")
        assert done.returncode == 0, done.stderr
        from legs_loss.config import find_config

        config = find_config(root / "train.py", environ={}, argv=[])
        assert (config.spec.curve, config.spec.operator, config.spec.beta) == ("C5", "sobel", 2.5)
        assert config.store == root / "maps"
        assert find_config(root / "train.py", environ={"LEGS_BETA": "7"}, argv=[]).spec.beta == 7.0

    def test_uncommitted_changes_are_refused_and_a_dry_run_is_not(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"), git=True)
        (root / "train.py").write_text("# mine\n" + files("inria")["train.py"])
        before = snapshot(root)
        refused = run(root)
        assert refused.returncode == 2
        assert "uncommitted changes in what would be patched (train.py): commit them, or use --force" in refused.stderr
        assert snapshot(root) == before
        assert run("--diff", root).returncode == 0
        assert run("--force", root).returncode == 0

    @pytest.mark.parametrize("format", ["sha1", "sha256"])
    @pytest.mark.parametrize("folder", ["", "code/[a]"])
    @pytest.mark.parametrize("attributes", ["", "*.py text eol=crlf\n"])
    def test_what_is_as_it_was_committed_is_patched(self, format, folder, attributes, tmp_path, run):
        """Changes of other files do not stop a patch, nor do the line ends that git writes; changes of its own do."""
        texts = {f"{folder}/{name}".lstrip("/"): text for name, text in files("inria").items()}
        checkout(tmp_path, {**texts, ".gitattributes": attributes})
        try:
            run_git(tmp_path, "init", "-q", f"--object-format={format}")
        except subprocess.CalledProcessError:
            pytest.skip("git knows one format of objects")
        for arguments in (["add", "."], ["commit", "-q", "-m", "start"]):
            run_git(tmp_path, *arguments)
        root = tmp_path / folder
        (root / "train.py").unlink()
        run_git(tmp_path, "checkout", "-q", "--", ".")
        assert (b"\r\n" in (root / "train.py").read_bytes()) == bool(attributes)
        (root / "scene" / "cameras.py").write_text("# mine\n" + files("inria")["scene/cameras.py"])
        assert run(root).returncode == 0
        assert run("--undo", root).returncode == 0
        (root / "train.py").write_bytes(b"# mine\n" + (root / "train.py").read_bytes())
        assert "(train.py): commit them" in run(root).stderr

    def test_what_cannot_be_decided_is_quoted_and_stops_it_only_if_strict(self, tmp_path, run):
        root = checkout(tmp_path, files("unknown_image_pair_error"))
        before = snapshot(root)
        refused = run("--strict", root)
        assert refused.returncode == 2
        assert "train.py:11: cannot tell which of image_a and image_b" in refused.stderr
        assert "loss = loss + l1_loss(image_a, image_b)" in refused.stderr
        assert "--site train.py:11 takes your word and writes legs_loss.l1_loss(image_a, image_b)\n" in refused.stderr
        assert snapshot(root) == before
        assert run("--diff", root).returncode == 1
        partial = run(root)
        assert partial.returncode == 1
        assert "legs_loss.l1_loss(image, cam.original_image)" in (root / "train.py").read_text()
        assert "l1_loss(image_a, image_b)" in (root / "train.py").read_text()

    def test_nothing_is_changed_where_nothing_can_be_decided(self, tmp_path, run):
        root = checkout(tmp_path, files("pixels_reshaped_to_list_error"))
        before = snapshot(root)
        done = run(root)
        assert done.returncode == 2
        assert "legs-patch: error: " in done.stderr
        assert 'nothing was changed: --trace "train.py ARGUMENTS" decides' in done.stderr
        assert snapshot(root) == before

    def test_a_line_that_the_user_names_is_rewritten_or_told_what_to_write(self, tmp_path, run):
        texts = files("inria")
        texts["train.py"] = texts["train.py"].replace(
            "        Ll1 = l1_loss(image, gt_image)\n",
            "        Ll1 = opt.criterion(image, gt_image)\n        Ll1 += ((image - gt_image) * 2).abs().mean()\n",
        )
        root = checkout(tmp_path, texts)
        line = texts["train.py"].splitlines().index("        Ll1 = opt.criterion(image, gt_image)") + 1
        diff = run("--diff", "--site", f"train.py:{line}", root).stdout
        assert "+        Ll1 = legs_loss.l1_loss(image, gt_image, own=opt.criterion)\n" in diff
        told = run("--site", f"train.py:{line + 1}", root)
        assert told.returncode == 2
        assert "edit it by hand: as one absolute difference times the photograph's weight map" in told.stderr
        assert (
            "train.py:1: there is no difference, absolute value or call of two images"
            in run("--site", "train.py:1", root).stderr
        )

    def test_json(self, tmp_path, run):
        root = checkout(tmp_path, files("channels_last_weighted"))
        done = run("--json", "--check", root)
        content = json.loads(done.stdout)
        assert done.returncode == 1
        found = [s["line"] for s in content["sites"] if s["file"] == "simple_trainer.py"]
        assert found[:4] == [16, 19, 25, 39]
        assert content["left"][0]["reason"] == "definition" or content["left"][0]["reason"] == "depth"
        assert "simple_trainer.py" in content["would_change"]
        assert content["wrote"] == []

    def test_calls_that_stay_plain_are_reported_and_undone(self, tmp_path, run):
        root = checkout(tmp_path, files("shared_loss_function_unweighted_call"))
        before = snapshot(root)
        content = json.loads(run("--json", root).stdout)
        assert [(plain["file"], plain["line"], plain["reason"]) for plain in content["plain"]] == [
            ("wrapped.py", 18, "distillation"),
            ("avatar.py", 15, "distillation"),
            ("train.py", 15, "distillation"),
            ("train.py", 17, "distillation"),
            ("train.py", 23, "depth"),
            ("slam.py", 7, "tracking"),
        ]
        assert content["plain"][2]["weighted_at"] == "utils/photometric.py:6"
        assert "slam.py" in content["wrote"]
        again = run(root)
        assert "nothing to do: it is patched" in again.stdout
        assert "slam.py:8                already patched\n" in again.stdout
        assert run("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_calls_of_a_body_chosen_by_hand_stay_plain_too(self, tmp_path, run):
        root = checkout(tmp_path, files("shared_loss_function_unweighted_call"))
        done = run("--site", "utils/photometric.py:17", root)
        assert done.returncode == 0, done.stderr
        assert "legs_loss.unweighted(rgb_loss)(" in (root / "slam.py").read_text()
        assert "import legs_loss" not in (root / "train.py").read_text()

    def test_a_site_by_hand(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        done = run("--site", "train.py:44", root)
        assert done.returncode == 0, done.stderr
        assert "l1_test += legs_loss.l1_loss(image, gt_image" in (root / "train.py").read_text()
        missing = run("--site", "train.py:3", root)
        assert missing.returncode == 2
        assert "train.py:3: there is no difference, absolute value or call of two images" in missing.stderr

    @pytest.mark.parametrize("name", ["maps \U0001f600 \u00e9", 'a "quoted" \\ one', "del \x7f, tab \t"])
    def test_a_store_of_any_name_is_read_back_from_legs_toml(self, name, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        done = run("--store", str(root / name), root)
        assert done.returncode == 0, done.stderr
        assert find_config(root / "train.py", argv=[], environ={}).store == root / name

    @pytest.mark.skipif(os.name != "posix", reason="paths are bytes on POSIX only")
    def test_a_store_that_is_no_text_is_refused_before_anything_is_written(self, tmp_path, run):
        root = checkout(tmp_path, files("inria"))
        before = snapshot(root)
        done = run("--store", os.fsdecode(b"maps-\xe9"), root)
        assert done.returncode == 2 and "its name is not in UTF-8" in done.stderr
        assert len(done.stderr.splitlines()) == 1 and snapshot(root) == before

    @pytest.mark.parametrize(
        "call", ["fast_ssim(image, gt_image)", "F.mse_loss(image, gt_image)", "lpips_fn(image, gt_image)"]
    )
    def test_another_measure_named_as_the_site_is_an_error_and_not_made_an_l1(self, call, tmp_path, run):
        text = files("inria")["train.py"].replace(
            "        loss.backward()\n", f"        other = {call}\n        loss.backward()\n"
        )
        assert text.count(call) == 1
        root = checkout(tmp_path, {**files("inria"), "train.py": text})
        before = snapshot(root)
        line = text[: text.index(call)].count("\n") + 1
        done = run("--site", f"train.py:{line}", root)
        name = call.partition("(")[0].split(".")[-1]
        assert done.returncode == 2 and f"train.py:{line}: {name} is by its name no L1" in done.stderr
        assert snapshot(root) == before

    def test_a_function_that_is_settled_at_run_time_is_weighted_by_hand(self, tmp_path, run):
        texts = files("loss_from_eval_or_getattr_error")
        root = checkout(tmp_path, texts)
        before = snapshot(root)
        line = texts["train.py"].splitlines().index("        loss1 = loss_func(image, gt_image)") + 1
        done = run("--site", f"train.py:{line}", root)
        assert done.returncode == 0, done.stderr
        text = (root / "train.py").read_text()
        assert "loss1 = legs_loss.l1_loss(image, gt_image, own=loss_func)\n" in text
        assert text.count("own=") == 1
        assert run("--undo", root).returncode == 0
        assert snapshot(root) == before

    def test_a_nested_checkout_is_patched_with_the_codebase_and_asked_by_its_own_git(self, tmp_path, run, monkeypatch):
        """As FasterGS is installed: cloned into a folder of NeRFICG that NeRFICG's git does not know."""
        inner = {path: without_marks(text) for path, text in files("registered_callable_weighted").items()}
        (loss,) = [path for path in inner if path.endswith("Loss.py")]
        root = checkout(tmp_path / "outer", {loss: inner[loss], "scripts/train.py": "import torch\n"}, git=True)
        nested = root / "src" / "Methods" / "FasterThing"
        checkout(nested, {"Loss.py": inner[loss], "Model.py": "import gaussian_splatting\n"}, git=True)
        before = snapshot(root)
        done = run(root, "--beta", "4")
        assert (done.returncode, done.stderr) == (0, "")
        assert "src/Methods/FasterThing/Loss.py:" in done.stdout
        for folder in (nested, (root / loss).parent):
            assert "legs_loss.l1_loss(input, target, own=" in (folder / "Loss.py").read_text()
        assert [path.name for path in root.rglob(".legs-patch.json")] == [".legs-patch.json"]
        assert run_git(nested, "status", "--short") == " M Loss.py\n"
        settings = find_config(nested / "Loss.py", environ={}, argv=[])  # past the nested .git, beside the journal
        assert settings.spec.beta == 4
        assert run("--undo", root).returncode == 0
        assert snapshot(root) == before
        (nested / "Loss.py").write_text("# mine\n" + inner[loss])
        refused = run(root)
        assert refused.returncode == 2
        assert "uncommitted changes in what would be patched (src/Methods/FasterThing/Loss.py)" in refused.stderr
        run_git(nested, "commit", "-q", "-a", "-m", "mine")
        assert run(root).returncode == 0

    def test_what_may_be_the_loss_in_folders_that_are_not_entered_is_said(self, tmp_path, run):
        other = {f"{at}/{path}": text for at in ("sub/gs", "third_party/x") for path, text in files("inria").items()}
        other = {path: without_marks(text) for path, text in other.items()}
        root = checkout(tmp_path, {**files("inria"), "third_party/plain/a.py": "l1_loss(a, b)\n", **other})
        (root / ".gitmodules").write_text("[submodule]\n\tpath = sub/gs\n[submodule]\n\tpath = third_party/x\n")
        (root / "third_party" / "x" / ".git").write_text("gitdir: ../../.git/modules/x\n")
        line = other["sub/gs/train.py"].splitlines().index(SITE.rstrip("\n")) + 1
        said = [
            f"legs-patch: warning: {at}/train.py:{line} may be the loss, and {at} is not searched (a submodule): "
            f"legs-patch {root}/{at}\n"
            for at in ("sub/gs", "third_party/x")
        ]
        for options in (["--check"], ["--check", "--json"], ["--diff"]):
            assert set(said) <= set(run(root, *options).stderr.splitlines(True))
        entries = json.loads(run(root, "--check", "--json").stdout)["unsearched"]
        assert [(each["file"], each["line"]) for each in entries] == [
            ("sub/gs/train.py", line),
            ("third_party/x/train.py", line),
        ]
        assert run(root, "--check", "--exclude", "sub", "--exclude", "third_party").stderr == ""
        assert run(root / "sub" / "gs").returncode == 0

    def test_a_link_to_code_outside_and_another_worktree_are_said(self, tmp_path, run):
        texts = {path: without_marks(text) for path, text in files("inria").items()}
        other, root = checkout(tmp_path / "other", texts), checkout(tmp_path / "own", texts, git=True)
        os.symlink(str(other), str(root / "methods"))  # ln -s ../FasterGS
        for name, to in (
            ("inside", "utils"),
            ("data", os.devnull),
            ("self", "."),
            ("nothing", "nowhere"),
            ("top", "/"),
        ):
            os.symlink(to, str(root / name))
        run_git(root, "worktree", "add", "-q", "branch", "HEAD")
        line = texts["train.py"].splitlines().index(SITE.rstrip("\n")) + 1
        done = run(root, "--json")
        why = ["another worktree of this checkout", "a link"]
        what = {"branch": f"branch/train.py:{line} may be the loss", "methods": "there is code there"}
        assert done.stderr.splitlines() == [
            f"legs-patch: warning: {said}, and {name} is not searched ({why.pop(0)}): legs-patch {root}/{name}"
            for name, said in what.items()
        ]
        report = json.loads(done.stdout)
        where = [(each["file"], each["line"]) for each in report["unsearched"]]
        assert where == [("branch/train.py", line), ("methods", 0)]
        assert report["wrote"] and {path.split("/")[0] for path in report["wrote"]}.isdisjoint({"methods", "branch"})
        assert (other / "train.py").read_text() == texts["train.py"]
        alone = checkout(tmp_path / "alone", {"run.py": "import os\n"})
        os.symlink(str(other), str(alone / "methods"))
        refused = run(alone)
        assert refused.returncode == 2
        assert "not searched: methods (a link): run legs-patch on the one that trains" in refused.stderr
        assert run(alone / "methods").returncode == 0

    def test_a_skipped_line_that_speaks_of_images_is_offered_where_nothing_was_found(self, tmp_path, run):
        step = "def train_texture(image, gt_image):\n    l1_loss(image.depth, gt_image.depth).backward()\n"
        done = run(checkout(tmp_path, {"a.py": "from gaussian_renderer import render\n\n\n" + step}))
        assert done.returncode == 2
        assert "if a skipped line is the loss, take it with --site a.py:5" in done.stderr

    def test_folders_that_are_not_entered_are_named_where_nothing_was_found(self, tmp_path, run):
        texts = {"run.py": "import os\n", "venv/x.py": "", "submodules/a.py": "", "extern/a.py": "", "tests/a.py": ""}
        root = checkout(tmp_path, texts)
        assert run(root).stderr.endswith(
            "; not searched: extern (third-party code), submodules (third-party code), tests (a folder of tests): "
            "run legs-patch on the one that trains\n"
        )
        assert "extern" not in run(root, "--exclude", "extern").stderr

    @pytest.mark.parametrize(
        ("path", "message"),
        [
            (
                "third_party/gs/train.py",
                "third_party/gs is not searched (a submodule): run legs-patch on that folder",
            ),
            (
                "third_party/train.py",
                "third_party is not searched (third-party code): run legs-patch on that folder",
            ),
            ("a/extern/b/c/train.py", "a/extern/b is not searched (third-party code): run legs-patch"),
            ("my_env/train.py", "my_env is not searched (a virtual environment)\n"),
            ("old/train.py", "it is not searched: excluded"),
            ("test_train.py", "it is not searched: excluded, not a .py file, a test or a link\n"),
            ("train.sh", "it is not searched"),
            ("broken.py", "does not parse (line 1: "),
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
            (["empty", "--undo"], "nothing to undo"),
            (["empty", "--site", "train.py"], "--site must be FILE:LINE"),
            (["empty", "--site", "train.py:²"], "--site must be FILE:LINE"),
            (["empty", "--site", "train.py:" + "9" * 5000], "--site must be FILE:LINE"),
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
        assert "legs.toml exists and is not as legs-patch wrote it" in refused.stderr
        assert run("--undo", root).returncode == 0
        assert (root / "legs.toml").read_text() == "beta = 3.0\n"


def test_a_line_of_another_framework_is_not_offered(tmp_path, run):
    text = "import mlx.core as mx\nfrom gaussian_renderer import render\n\n\ndef loss_fn(gaussians, cam):\n"
    text += "    image = render(cam, gaussians, None, None)\n    return mx.mean(mx.abs(image - cam.original_image))\n"
    done = run(checkout(tmp_path, {**files("inria"), "train.py": text}))
    assert "no photometric L1 term was found" in done.stderr
    assert "train.py:1: JAX or MLX is imported" in done.stderr
    assert "take it with" not in done.stderr


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ("import jax\n", 1, "JAX or MLX is imported"),
        ("import mlx.core as mx\n", 1, "JAX or MLX is imported"),
        ("class BadModel(SplatfactoModel):\n    pass\n", 1, "ns-train splatfacto-legs"),
        ("\nkind = PhotoLoss.L1\n", 2, "seems to be chosen here, by an entry of a table"),
        ("\nkinds = {'l1': F.l1_loss, 'l2': None}\n", 2, "seems to be chosen here, by an entry of a table"),
        (
            "chosen = functools.partial(F.l1_loss, reduction='mean')\n",
            1,
            "seems to be chosen here, by an entry of a table",
        ),
        ("loss_fn = getattr(losses, cfg.kind)\n", 1, "seems to be chosen here, by a setting"),
        ("# mse_loss(image, gt)\nloss = F.mse_loss(image, gt_image)\n", 2, "a squared loss of images"),
        ("delta = image - photo\nloss = (delta**2).mean()\n", 2, "a squared loss of images"),
        ("loss += self.guidance(images, prompts)['loss_sds']\n", 1, "a gradient by a diffusion model (SDS)"),
        ("loss = fused_ssim.fused_l1_ssim_loss(img, gt)\n", 1, "take both apart"),
        (
            "class M(S):\n    def get_loss_dict(self, *a):\n        return super().get_loss_dict(*a)\n",
            3,
            "ns-train splatfacto-legs",
        ),
    ],
)
def test_what_is_not_ours_is_one_line(text, line, what, tmp_path, run):
    done = run(checkout(tmp_path, {"train.py": text}))
    assert done.returncode == 2
    assert done.stderr.splitlines()[0].startswith("legs-patch: error: no photometric L1 term was found")
    (said,) = done.stderr.splitlines()[1:]
    assert said.startswith(f"train.py:{line}: ")
    assert what in said


@pytest.mark.parametrize(
    ("path", "text", "line"),
    [
        ("train.py", "@LOSSES.register\ndef f():\n    pass\n\nloss = LOSSES[kind](image, gt)\n", 5),
        ("train.py", "x = 1\ncriterion = LOSS_REGISTRY.get(opt.kind)\n", 2),
        ("train.py", "class Trainer:\n    def make(self, cfg):\n        self.criterion = LOSSES[cfg.loss.type]\n", 3),
        ("train.py", "loss_fn = build_loss(cfg.loss)\n", 1),
        ("train.py", "loss_fn = eval(f'{kind}_loss')\n", 1),
        ("train.py", "loss_fn = globals()[args.loss]\n", 1),
        ("train.py", "criterion = hydra.utils.instantiate(cfg.loss)\n", 1),
        ("train.py", "losses = importlib.import_module(settings.losses)\n", 1),
        ("train.py", "import enum\n\n\nclass PhotoLoss(str, enum.Enum):\n    FIRST = 'l1'\n", 4),
        ("train.py", "if kind is ImageLoss.MAE:\n    pass\n", 1),
        ("configs/a.yaml", "model: x\nloss: l1\n", 2),
        ("configs/a.yaml", "loss:\n  weight: 0.2\n  _target_: torch.nn.L1Loss\n", 3),
        ("configs/a.yml", "model:\n  criterion:\n    - name: L1Loss  # mean\n", 3),
        ("a.json", '{"a": 1,\n "loss": {"weight": 1, "type": "l1"}}', 2),
        ("a.toml", '[train.loss]\nkind = "mae"\n', 2),
    ],
)
def test_the_line_that_chooses_a_loss_is_named(path, text, line, tmp_path):
    root = checkout(tmp_path, {"other.py": "import os\n", path: text})
    [said] = trained_instead(root, (), plan(root).findings)
    assert said.startswith(f"{path}:{line}: the loss seems to be chosen here, by ")


CHOSEN = """
from gaussian_renderer import render


def training(gaussians, cams, cfg):
    loss_fn = build_loss(cfg.loss)
    for cam in cams:
        loss_fn(render(cam, gaussians)["render"], cam.original_image).backward()
        gaussians.optimizer.step()
"""


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (CHOSEN, "warning: finetune.py:6: the loss seems to be chosen here, by a setting"),
        (
            CHOSEN.replace("build_loss(cfg.loss)", "LossKind[cfg.loss].value"),
            "warning: finetune.py:6: the loss seems to be chosen here, by a setting",
        ),
        (CHOSEN.replace(".backward()", ""), ""),  # nothing is trained
        (CHOSEN.replace("gaussian_renderer", "vae").replace("gaussians", "model"), ""),
    ],
)
def test_a_script_that_chooses_its_loss_is_named_beside_one_that_is_weighted(other, said, tmp_path, run):
    root = checkout(tmp_path, {**files("runnable_train_script_weighted"), "tools/finetune.py": other})
    for arguments in (("--check",), ("--check", "--json"), ()):
        done = run(*arguments, root)
        assert [line.replace("tools/", "") for line in done.stderr.splitlines() if "chosen" in line] == [
            f"legs-patch: {said}: name the line that calls it with --site" for said in [said] if said
        ], done.stderr
    assert "chosen" not in run("--check", "--site", "train.py:60", root).stderr


def test_settings_and_dictionaries_of_losses_choose_none(tmp_path):
    code = "loss = losses[i]\ntotal = sum(losses[k] for k in losses)\nlosses[name] = 1\nlog(losses[name])\n"
    settings = "lambda_l1: 0.8\nloss_weight: 1\nname: l1\nssim_loss: true\n"
    root = checkout(tmp_path, {"train.py": code, "a.yaml": settings, "b.json": '{"l1_loss": 0.8, "type": "l1"}'})
    os.mkfifo(root / "pipe.yaml")
    assert list(trained_instead(root, (), plan(root).findings)) == []


def test_squares_of_poses_and_definitions_are_not_the_image_loss(tmp_path, run):
    text = "def mse_loss(image, gt):\n    return 0\n\nloss = F.mse_loss(poses, poses_gt)\nx = F.mse_loss(image, gt)\n"
    assert run(checkout(tmp_path, {"train.py": text})).stderr.count("\n") == 1


def test_models_that_are_only_used_are_not_searched_and_a_script_by_the_name_of_a_test_is(tmp_path, run):
    texts = files("inria")
    untrained = "def l1(self, image, gt):\n    return (image - gt).abs().mean()\n"
    elsewhere = {"src/dust3r/croco/criterion.py": untrained, "splat_test.py": texts["train.py"], **texts}
    root = checkout(tmp_path, {**elsewhere, **{f"vggt/{path}": text for path, text in texts.items()}})
    done = run("--check", root)
    patched = [row.split(":")[0] for row in done.stdout.splitlines() if " patched " in row]
    assert patched == ["splat_test.py", "train.py"]
    assert "dust3r" not in done.stdout + done.stderr
    [beside] = [line for line in done.stderr.splitlines() if "vggt" in line]
    assert re.search(r"vggt/train\.py:\d+ may be the loss, and vggt is not searched", beside)
    assert beside.endswith(f": legs-patch {root}/vggt")


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
