"""The first ten minutes of a new user: typos, wrong folders, a store elsewhere. Each gets a clear answer."""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from legs_adapters.cli import main as patch
from PIL import Image

from legs_loss import LegsError, WeightSpec
from legs_loss.cli import main
from legs_loss.errors import did_you_mean
from legs_loss.precompute import precompute
from legs_loss.scenes import read_scene
from tests.support import ROOT, colmap_scene, legs_environment, photograph, save


@pytest.fixture
def scene(tmp_path):
    return colmap_scene(tmp_path / "a scene", names=[f"{i}.png" for i in range(3)])


def says(capsys, *arguments, main=main):
    """Run a command in this process; return its exit code and its stderr."""
    try:
        code = main([str(argument) for argument in arguments])
    except SystemExit as left:
        code = left.code
    return code, capsys.readouterr().err


OLD = sys.version_info < (3, 8)


class TestTypos:
    @pytest.mark.parametrize(
        ("arguments", "meant"),
        [
            (["precomput", "x"], "precompute"),
            (["precompute", "x", "--preset", "legz"], "legs"),
            (["precompute", "x", "--resoluton", "2"], "--resolution"),
            (["precompute", "x", "--resoluton=2"], "--resolution"),
            (["train", "x", "--densify_grad_treshold", "2"], "--densify_grad_threshold"),
        ],
    )
    def test_the_name_that_was_meant_is_proposed(self, capsys, arguments, meant):
        code, text = says(capsys, *arguments)
        assert code == 2
        assert text.endswith(f"did you mean {meant!r}?\n")
        assert text.startswith("usage: legs" + (" " + arguments[0] if len(arguments) > 2 else ""))

    @pytest.mark.parametrize(
        ("option", "meant"),
        [("--verfy", "--verify"), ("--preset=legz", "legs"), ("--curve=c33", "C3"), ("--operator=sobl", "sobel")],
    )
    def test_legs_patch_proposes_it_too(self, capsys, tmp_path, option, meant):
        code, text = says(capsys, tmp_path, option, main=patch)
        assert code == 2
        assert text.endswith(f"did you mean {meant!r}?\n")
        assert "legs-patch: error: " in text

    def test_nothing_is_proposed_for_what_is_like_nothing(self, capsys):
        code, text = says(capsys, "zzz")
        assert code == 2
        assert "did you mean" not in text

    @pytest.mark.parametrize(
        ("settings", "meant"),
        [({"curve": "c3"}, "C3"), ({"curve": "C33"}, "C3"), ({"operator": "laplacien"}, "laplacian")],
    )
    def test_settings(self, settings, meant):
        with pytest.raises(LegsError, match=rf"did you mean '{meant}'\?$"):
            WeightSpec(**settings)

    def test_a_name_that_is_there_is_not_proposed_to_itself(self):
        assert did_you_mean(3, ["legs"]) == ""


class TestStoreElsewhere:
    def test_precompute_says_that_no_training_will_find_it(self, capsys, scene, tmp_path):
        code, text = says(capsys, "precompute", scene, "--out", tmp_path / "my maps", "--workers", 1)
        assert code == 0
        assert f"LEGS_STORE='{tmp_path / 'my maps'}'" in text
        code, text = says(capsys, "precompute", scene, "--workers", 1)
        assert code == 0
        assert "LEGS_STORE" not in text

    def test_the_store_remembers_its_scene(self, scene, tmp_path, monkeypatch):
        pytest.importorskip("matplotlib")
        from legs_loss.cli.shared import sheet

        shown = []
        monkeypatch.setattr(sheet, "save_sheet", lambda path, views, spec, title: shown.extend(views))
        store = precompute(read_scene(scene), tmp_path / "store", resolution=2).store
        assert main(["show", str(store)]) == 0
        assert [view.photograph.shape for view in shown] == [(15, 20, 3)] * 3
        # A photograph that is another one now is not shown as the map's.
        save(scene / "images" / "1.png", photograph(40, 30, 99))
        shown.clear()
        assert main(["show", str(store)]) == 0
        assert [view.photograph is None for view in shown] == [False, True, False]

    def test_a_note_that_is_damaged_or_leads_nowhere_is_no_error(self, scene, tmp_path, monkeypatch):
        pytest.importorskip("matplotlib")
        from legs_loss.cli.shared import sheet

        shown = []
        monkeypatch.setattr(sheet, "save_sheet", lambda path, views, spec, title: shown.extend(views))
        store = precompute(read_scene(scene), tmp_path / "store").store
        for note in ("{", "[]", '{"scene": 3, "images": null}', '{"scene": "/nowhere", "images": null}'):
            (store / "scene.json").write_text(note)
            assert main(["show", str(store)]) == 0
        assert all(view.photograph is None for view in shown)

    def test_photographs_from_another_folder(self, scene, tmp_path):
        from legs_loss.precompute.origin import scene_of_store

        (scene / "images").rename(tmp_path / "photographs")
        store = precompute(read_scene(scene, str(tmp_path / "photographs")), tmp_path / "store").store
        assert [view.path.is_file() for view in scene_of_store(store).views] == [True] * 3


class TestResolution:
    def test_a_width_that_was_meant_as_a_divisor(self, capsys, scene):
        code, text = says(capsys, "precompute", scene, "-r", 3, "--workers", 1)
        assert code == 0
        assert "-r 3 makes images of 3x2 pixels" in text
        for resolution in (1, 2, 40, 100):
            assert "warning" not in says(capsys, "precompute", scene, "-r", resolution, "--workers", 1)[1]

    def test_training_checks_before_its_bar(self, capsys, scene, tmp_path):
        pytest.importorskip("numba")
        folder = save(tmp_path / "folder" / "a.png", photograph(8, 8)).parent
        for arguments, message in (
            ([scene, "-r", "0"], "resolution must be"),
            ([folder], "view(s) none is left"),
            ([tmp_path / "none"], "there is no folder"),
        ):
            code, text = says(capsys, "train", *arguments, "-m", tmp_path / "run")
            assert code == 2
            assert text.startswith("legs: error: ")
            assert text.count("\n") == 1
            assert message in text
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize("command", ["train", "compare", "demo"])
    def test_photographs_without_cameras_are_met_before_anything_is_computed(self, capsys, scene, tmp_path, command):
        pytest.importorskip("numba")
        pytest.importorskip("matplotlib")
        code, text = says(capsys, command, scene / "images", "--out", tmp_path / "run")
        assert (code, text.count("\n")) == (2, 1)
        assert "is a folder of pictures without camera poses: training needs a scene with sparse/0 of COLMAP" in text
        assert not (tmp_path / "run").exists()


class TestWhatIsNotThere:
    def test_info_of_a_scene_without_a_store(self, capsys, scene, tmp_path):
        code, text = says(capsys, "info", scene)
        assert code == 2
        assert "has 3 photograph(s) and no weight maps yet: legs precompute '" in text
        assert "there is no folder" in says(capsys, "info", tmp_path / "none")[1]

    def test_show_of_a_file_that_is_missing(self, capsys, tmp_path):
        code, text = says(capsys, "show", tmp_path / "missing.jpg")
        assert code == 2
        assert text.startswith(f"legs: error: there is no file or folder {tmp_path / 'missing.jpg'}: ")

    def test_a_scene_that_is_a_file(self, capsys, tmp_path):
        Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(str(tmp_path / "a.png"))
        assert "a.png is a file: a scene is a folder" in says(capsys, "precompute", tmp_path / "a.png")[1]


class TestFirstQuarterOfAnHour:
    def test_legs_alone_gives_help(self, capsys):
        assert main([]) == 0
        text = capsys.readouterr().out
        assert text.startswith("usage: legs ") and "\n    precompute " in text

    @pytest.mark.parametrize(
        "command", ["precompute", "export", "show", "info", "compare", "demo", "scene", "train", "view"]
    )
    def test_a_description_names_its_arguments_as_the_usage_does(self, capsys, command):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        usage, description = capsys.readouterr().out.split("\n\n")[:2]
        arguments = r"\b(?:PATH|SCENE|STORE|OUT|RUN|PLY|PHOTOS|DIR|FOLDER|FILE|COMPARISON)\b"
        assert set(re.findall(arguments, description)) <= set(re.findall(arguments, usage))

    def test_legs_patch_and_the_sub_command_are_one(self, capsys, tmp_path):
        import legs_adapters.cli as command

        parser = argparse.ArgumentParser()
        command.add_arguments(parser)
        outputs = []
        for call in (patch, lambda given: command.run(parser.parse_args(given))):
            assert call([str(tmp_path), "--diff"]) == 2
            outputs.append(capsys.readouterr())
        assert outputs[0] == outputs[1]
        assert "no photometric L1 term was found" in outputs[0].err

    def test_photographs_of_a_scene_are_no_scene(self, capsys, scene, tmp_path):
        code, text = says(capsys, "precompute", scene / "images", "--workers", 1)
        assert code == 2
        assert text.endswith(f"give the scene: legs precompute '{scene}'\n")
        assert not (scene / "images" / "legs_weights").exists()
        (scene / "images").rename(scene / "images_2")
        assert text.count("\n") == 1
        assert says(capsys, "precompute", scene / "images_2", "--workers", 1)[1].endswith(" --images images_2\n")
        assert says(capsys, "precompute", scene / "images_2", "--out", tmp_path / "maps", "--workers", 1)[0] == 0

    @pytest.mark.parametrize("command", ["precompute", "train", "compare", "demo"])
    def test_a_folder_that_cannot_be_written_is_met_before_anything_is_computed(self, capsys, scene, tmp_path, command):
        pytest.importorskip("numba")
        pytest.importorskip("matplotlib")
        (tmp_path / "file").write_text("")
        code, text = says(capsys, command, scene, "--out", tmp_path / "file" / "run")
        assert code == 2
        assert re.fullmatch(r"legs: error: cannot write to .*: (Not a directory|File exists)\n", text)

    def test_a_bad_value_comes_before_the_run_that_is_there(self, capsys, scene, tmp_path):
        pytest.importorskip("numba")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "checkpoint.npz").write_bytes(b"")
        for arguments, message in ((["--iterations", "-1"], "iterations must"), ([], "already holds a run")):
            code, text = says(capsys, "train", scene, "--out", tmp_path / "run", *arguments)
            assert (code, text.count("\n")) == (2, 1)
            assert message in text

    def test_cpu_behind_the_script(self, tmp_path):
        script = tmp_path / "train.py"
        script.write_text("print('ran')\n")
        command = [sys.executable, "-m", "legs_loss", "run", str(script), "--cpu"]
        done = subprocess.run(command, capture_output=True, text=True, env=legs_environment())
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.endswith(f"which does not know it: legs run --cpu {script} ...\n")

    @pytest.mark.parametrize("module", ["legs_loss", "legs_adapters.cli"])
    def test_completion_into_a_pipe_that_closes(self, module):
        pytest.importorskip("shtab")
        command = f"{shlex.quote(sys.executable)} -m {module} --print-completion bash | head -n 1"
        done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, env=legs_environment())
        assert done.stdout.startswith("# AUTOMATICALLY GENERATED")
        assert done.stderr == ""

    def test_the_extra_of_the_report_has_what_the_report_needs(self):
        tomllib = pytest.importorskip("tomllib")
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert {"legs-loss[cpu]", "matplotlib>=3.5", "jinja2>=3"} <= set(extras["report"])
        assert any(one.startswith("numba") for one in extras["cpu"])
        users = set(extras) - {"all", "test", "docs", "lint"}
        assert set(re.findall(r"\w+", extras["all"][0][len("legs-loss") :])) == users

    @pytest.mark.parametrize(
        ("package", "extra", "arguments"),
        [
            ("numba", "cpu", ["run", "--cpu", "train.py"]),
            ("numba", "cpu", ["patch", "--verify", "."]),
            *([("asttokens", "patch", ["run", "train.py"]), ("asttokens", "patch", ["patch", "."])] * OLD),
            ("numba", "cpu", ["compare"]),
            ("matplotlib", "report", ["demo"]),
            ("jinja2", "report", ["report", "."]),
            ("matplotlib", "report", ["show", "train.png"]),
            ("pycolmap", "colmap", ["scene", ".", "out"]),
            ("shtab", "completion", ["--print-completion", "bash"]),
        ],
    )
    def test_a_missing_extra_is_one_line(self, capsys, monkeypatch, tmp_path, package, extra, arguments):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "train.py").write_text("print(1)")
        save(tmp_path / "train.png", photograph(16, 16))
        monkeypatch.setitem(sys.modules, package, None)
        code, text = says(capsys, *arguments)
        lines = text.strip().splitlines()
        assert code == 2 and len(lines) == 1, text
        assert lines[0].endswith(
            f"needs {package}: pip install {package}, or, in the checkout of legs-loss, pip install '.[{extra}]'"
        )


class TestCommandsToCopy:
    def test_undo_with_a_space_in_the_path(self, tmp_path):
        checkout = tmp_path / "my gs"
        checkout.mkdir()
        (checkout / "train.py").write_text(
            "from gaussian_renderer import render\nfrom utils.loss_utils import l1_loss\n\n\n"
            "def training(scene, gaussians):\n    for cam in scene:\n        image = render(cam, gaussians)['render']\n"
            "        loss = l1_loss(image, cam.original_image.cuda())\n        loss.backward()\n"
        )
        before = (checkout / "train.py").read_text()
        from contextlib import redirect_stdout
        from io import StringIO

        with redirect_stdout(StringIO()) as output:
            assert patch([str(checkout)]) == 0
        command = output.getvalue().split("undo it with: ")[1].strip()
        assert command == f"legs-patch --undo '{checkout}'"
        assert patch(shlex.split(command)[1:]) == 0
        assert (checkout / "train.py").read_text() == before

    def test_extras_are_quoted_wherever_they_are_printed(self):
        texts = [path for folder in ("legs_loss", "adapters", "docs") for path in (ROOT / folder).rglob("*.py")]
        for path in [*texts, *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
            for line in path.read_text(encoding="utf-8").splitlines():
                if re.search(r"pip install [\w.-]+\[", line):
                    pytest.fail(f"{path}: {line.strip()}")


class TestCompletion:
    def test_shells_get_a_script(self, capsys):
        pytest.importorskip("shtab")
        for shell, word in (("bash", "complete -o "), ("zsh", "#compdef {}"), ("tcsh", "complete {}")):
            for name, command, option in (("legs", main, "--white_background"), ("legs-patch", patch, "--exclude")):
                with pytest.raises(SystemExit) as left:
                    command(["--print-completion", shell])
                assert left.value.code == 0
                script = capsys.readouterr().out
                assert word.format(name) in script
                assert option in script or (shell == "tcsh" and option[2:] in script)

    def test_bash_completes_options_sub_commands_and_paths(self, tmp_path):
        pytest.importorskip("shtab")
        if shutil.which("bash") is None:
            pytest.skip("no bash")
        (tmp_path / "a_checkout").mkdir()
        (tmp_path / "a_file.py").write_text("")
        for program, words, wanted in (
            ("legs", ["preco"], {"precompute"}),
            ("legs", ["precompute", "--resol"], {"--resolution"}),
            ("legs-patch", ["--ver"], {"--version", "--verify"}),
            ("legs-patch", ["a_"], {"a_checkout"}),
            ("legs", ["run", "a_"], {"a_checkout", "a_file.py"}),
        ):
            module = {"legs": "legs_loss.cli", "legs-patch": "legs_adapters.cli"}[program]
            call = f"from {module} import main; main(['--print-completion', 'bash'])"
            completion = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True, check=True).stdout
            function = re.search(rf"^complete .*-F (\w+) {program}$", completion, re.MULTILINE)
            ask = f"COMP_WORDS=({program} {' '.join(words)})\nCOMP_CWORD={len(words)}\n{function.group(1)}\n"
            done = subprocess.run(
                ["bash", "-c", completion + ask + 'printf "%s\\n" "${COMPREPLY[@]}"'],
                cwd=str(tmp_path), capture_output=True, text=True,
            )  # fmt: skip
            assert set(done.stdout.split()) == wanted, done.stderr

    @pytest.mark.parametrize("command", [main, patch])
    def test_without_shtab_it_says_what_to_install(self, capsys, monkeypatch, command):
        monkeypatch.setitem(sys.modules, "shtab", None)
        code, text = says(capsys, "--print-completion", "bash", main=command)
        assert code == 2
        assert "pip install shtab, or, in the checkout of legs-loss, pip install '.[completion]'" in text


class TestWhatIsOffered:
    @pytest.mark.parametrize(
        ("arguments", "most", "advanced"),
        [
            (["patch"], 11, "advanced: which terms"),
            (["train"], 10, "advanced: the training"),
            (["compare"], 9, "advanced"),
        ],
    )
    def test_the_basic_options_are_few_and_come_first(self, capsys, arguments, most, advanced):
        with pytest.raises(SystemExit):
            main([*arguments, "--help"])
        basic, found, rest = capsys.readouterr().out.partition(f"\n{advanced}:\n")
        options = re.findall(r"^  (?:-\w[^-]*)?--(\w+)", basic.partition("\noptions:")[2], re.M)
        assert found
        assert 4 <= len(options) <= most
        assert len(re.findall(r"^  --", rest, re.M)) >= 3

    def test_studies_of_our_own_pages_are_examples(self, capsys):
        code, text = says(capsys, "compare", "--study", "noise")
        assert code == 2 and "main" in text and "controls" in text
        for option in ("--again", "--first_seed", "--upstream"):
            assert says(capsys, "compare", option, "3")[0] == 2
        for script in ("compare", "reproduce", "schedule", "distractors"):
            assert (ROOT / "examples" / "reproduce_paper" / f"{script}.py").is_file()

    def test_the_docs_need_nothing_of_the_package(self):
        tomllib = pytest.importorskip("tomllib")
        extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
        assert not [one for one in extras["docs"] if one.startswith(("legs-loss", "torch"))]
        assert "[test]" not in (ROOT / "Makefile").read_text().partition("$(VENV)/.docs:")[2].partition("\n\n")[0]

    def test_the_demo_ends_with_how_to_look(self):
        if shutil.which("make") is None:
            pytest.skip("no make")
        done = subprocess.run(["make", "-n", "demo", "VENV=here"], cwd=str(ROOT), capture_output=True, text=True)
        lines = done.stdout.splitlines()  # within another make it says last which folder it leaves
        assert "source here/bin/activate" in lines[lines.index("here/bin/legs demo") + 1]

    @pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
    def test_when_to_use_it_and_when_not(self, page):
        lines = [line for line in (ROOT / page).read_text().splitlines() if line.startswith("- **")]
        assert [line.split("**")[1] for line in lines[:3]] == ["Use it", "Do not use it", "Measure it"]
        assert "contours" in lines[0] and "more Gaussians are acceptable" in lines[0]
        assert "fixed" in lines[1]

    def test_what_users_ask_is_answered(self):
        answers = (ROOT / "docs" / "index.md").read_text().partition("## Questions\n")[2]
        for question in ("blurry", "Floaters", "exposure", "Masks", "cap", "Noise", "slower", "Windows", "MPS"):
            [answer] = re.findall(rf"^\*\*[^*]*{question}[^*]*\*\*(?:.+\n)+", answers, re.M)
            assert 8 <= len(answer.split()) <= 90, question
