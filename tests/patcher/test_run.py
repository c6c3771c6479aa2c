"""A patched script trains as it should, and ``legs run`` is the same patch without touching a file."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest

from legs_loss.lab.embedded import write_embedded_scene
from tests.patcher.support import checkout, files, legs_patch, snapshot
from tests.preloaded import run
from tests.support import legs, legs_environment


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_embedded_scene(tmp_path_factory.mktemp("scene"), views=4, width=48, height=36, points=400, samples=1)


def python(*arguments, cwd, **variables):
    environment = {name: value for name, value in legs_environment().items() if not name.startswith("LEGS_")}
    return run([sys.executable, *map(str, arguments)], cwd=cwd, env=dict(environment, **variables))


def by_python(*arguments, cwd, **variables):
    """The same by a Python of its own: what it prints of an error begins there."""
    environment = {name: value for name, value in legs_environment().items() if not name.startswith("LEGS_")}
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=str(cwd),
        env=dict(environment, **variables),
        capture_output=True,
        text=True,
        timeout=300,
    )


def result(done):
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def runs(scene, tmp_path_factory):
    """The runs that the tests compare: each is a training of its own process."""
    root = checkout(tmp_path_factory.mktemp("checkout"), files("runnable_train_script_weighted"))
    train = ("train.py", "-s", scene)
    found = {"unpatched": result(python(*train, cwd=root))}
    before = snapshot(root)
    found["in memory"] = result(python("-m", "legs_loss", "run", *train, cwd=root))
    assert snapshot(root) == before
    assert legs_patch(root).returncode == 0
    done = python(*train, cwd=root)
    found["patched"], found["said"] = result(done), done.stderr
    found["off"] = result(python(*train, cwd=root, LEGS_OFF="1"))
    text = (root / "utils" / "loss_utils.py").read_text()
    assert legs_patch("--undo", root).returncode == 0
    # Not the patch but legs_loss itself, called where the script calls its own l1_loss.
    direct = text.replace(
        "    return torch.abs((network_output - gt)).mean()",
        "    if not network_output.requires_grad:\n        return torch.abs((network_output - gt)).mean()\n"
        "    return reference.weighted_l1(network_output, gt, reference.weight_map(gt, 'legs'))",
    )
    assert direct != text
    (root / "utils" / "loss_utils.py").write_text(direct)
    found["direct"] = result(python(*train, cwd=root))
    return found


class TestTraining:
    def test_the_patched_script_s_losses_are_those_of_calling_legs_loss(self, runs):
        patched, direct = ([float.fromhex(loss) for loss in runs[run]["losses"]] for run in ("patched", "direct"))
        assert patched == pytest.approx(direct, rel=1e-4)  # l1_loss is one compiled pass; the other sums as torch does
        assert float.fromhex(runs["patched"]["test"]) == pytest.approx(float.fromhex(runs["direct"]["test"]), rel=1e-4)
        assert runs["patched"]["losses"] != runs["unpatched"]["losses"]

    def test_off_is_the_unpatched_run_to_the_last_bit(self, runs):
        assert runs["off"]["losses"] == runs["unpatched"]["losses"]
        assert runs["off"]["test"] == runs["unpatched"]["test"]

    @pytest.mark.slow
    def test_so_is_beta_0_and_off_in_memory(self, runs, scene, tmp_path):
        root = checkout(tmp_path, files("runnable_train_script_weighted"))
        train = ("-m", "legs_loss", "run", "train.py", "-s", scene)
        for variables in ({"LEGS_BETA": "0"}, {"LEGS_OFF": "1"}, {"LEGS_PRESET": "3dgs"}):
            assert result(python(*train, cwd=root, **variables))["losses"] == runs["unpatched"]["losses"]

    @pytest.mark.slow
    def test_the_compiled_rasterizer_trains_on_the_whole_scene(self, tmp_path):
        scene = write_embedded_scene(tmp_path / "scene", views=6, width=96, height=72, points=1500, samples=1)
        root = checkout(tmp_path / "checkout", files("runnable_train_script_weighted"))
        train = ("train.py", "-s", scene, "--iterations", "60", "--points", "1500")
        plain = result(python(*train, cwd=root))["losses"]
        weighted = result(python("-m", "legs_loss", "run", *train, cwd=root))["losses"]
        assert float.fromhex(weighted[-1]) < 0.85 * float.fromhex(weighted[0])
        assert result(python("-m", "legs_loss", "run", *train, cwd=root, LEGS_OFF="1"))["losses"] == plain

    def test_in_memory_is_the_same_run(self, runs):
        assert runs["in memory"]["losses"] == runs["patched"]["losses"]

    def test_the_first_step_says_what_is_active_and_the_end_how_many_were(self, runs):
        lines = [line for line in runs["said"].splitlines() if line.startswith("legs-loss: ")]
        assert len(lines) == 2
        assert "preset legs: laplacian, C3, beta 10" in lines[0]
        assert "legs.toml" in lines[0]
        assert lines[1] == "legs-loss: 8 step(s) weighted, 0 plain with a gradient"

    def test_the_losses_fall(self, runs):
        first, last = (float.fromhex(runs["patched"]["losses"][i]) for i in (0, -1))
        assert last < first


class TestAsPythonRunsIt:
    def test_arguments_name_and_file(self, runs, scene):
        for name in ("in memory", "unpatched"):
            run = runs[name]
            assert (run["argv"], run["name"]) == (["-s", str(scene)], "__main__")
            assert os.path.basename(run["file"]) == "train.py"

    def script(self, root, body):
        """Write a codebase whose train.py ends in ``body``; it never trains, and loads no torch."""
        texts = files("inria")
        head = texts["train.py"].split("if __name__")[0].replace("import torch\n", "import random as torch\n")
        texts["train.py"] = head + textwrap.dedent(body)
        texts["utils/loss_utils.py"] = (
            texts["utils/loss_utils.py"]
            .replace("import torch\n", "", 1)
            .replace("import torch.nn.functional as F\n", "")
        )
        texts["scene/gaussian_model.py"] = texts["scene/gaussian_model.py"].replace("import torch\n", "")
        return checkout(root, texts)

    def both(self, root, *arguments):
        return by_python("-m", "legs_loss", "run", *arguments, cwd=root), by_python(*arguments, cwd=root)

    @pytest.mark.parametrize(
        "body",
        [
            "import sys\nsys.exit(7)\n",
            "import sys\nsys.exit('a message')\n",
            """
            import __main__, atexit, multiprocessing, pickle, sys
            class A: pass
            print(sys.modules["__mp_main__"] is __main__)  # by this name a spawned process sends its own A
            print(sys.path[0], sys.argv, __file__, __name__, __doc__, __spec__)
            print(training.__module__, __main__.__file__, __main__.A is A, type(pickle.loads(pickle.dumps(A()))))
            atexit.register(print, 'bye')
            raise SystemExit
            """,
        ],
        ids=["exit code", "exit message", "names"],
    )
    def test_the_same_output_and_exit_code(self, body, tmp_path):
        run, plain = self.both(self.script(tmp_path, body), "train.py", "-x", "--flag", "--", "last")
        assert (run.returncode, run.stdout) == (plain.returncode, plain.stdout)
        noise = [line for line in run.stderr.splitlines() if not line.startswith("legs-loss: ")]
        assert noise == plain.stderr.splitlines()

    @pytest.mark.skipif(sys.version_info < (3, 11), reason="without -P")
    def test_without_the_scripts_folder_the_path_is_as_python_has_it(self, tmp_path):
        (tmp_path / "plain.py").write_text("import sys\nprint(sys.path)\n", encoding="utf-8")
        code = "import sys\nfrom legs_adapters.rewritten import execute\nsys.exit(execute(['plain.py'], {}))"
        run, plain = by_python("-P", "-c", code, cwd=tmp_path), by_python("-P", "plain.py", cwd=tmp_path)
        assert (run.returncode, run.stdout) == (plain.returncode, plain.stdout), run.stderr

    def test_tracebacks_point_at_the_right_lines(self, tmp_path):
        root = self.script(
            tmp_path,
            """
            def broken(*arguments):
                raise RuntimeError("here")
            l1_loss = broken
            torch.clamp = broken
            training_report(0, 0, 0, broken, [0], type("S", (), {"getTestCameras": lambda s: [s], "gaussians": 0})(),
                            lambda *a: {"render": 0})
            """,
        )
        run, plain = self.both(root, "train.py")
        assert (run.returncode, plain.returncode) == (1, 1)
        assert [line for line in run.stderr.splitlines() if not line.startswith("legs-loss: ")] == (
            plain.stderr.splitlines()
        )
        assert "in training_report" in run.stderr

    @pytest.mark.parametrize("text", ["x = (1,\ny = 2\n", "import broken\n"])
    def test_a_syntax_error_is_shown_as_python_shows_it(self, text, tmp_path):
        (tmp_path / "train.py").write_text(text, encoding="utf-8")
        (tmp_path / "broken.py").write_text("def f(:\n    pass\n", encoding="utf-8")
        code = "import sys\nfrom legs_adapters.rewritten import execute\nsys.exit(execute(['train.py'], {}))"
        run, plain = by_python("-c", code, cwd=tmp_path), by_python("train.py", cwd=tmp_path)
        assert "SyntaxError" in plain.stderr
        assert (run.returncode, run.stderr) == (plain.returncode, plain.stderr)

    @pytest.mark.skipif(os.name != "posix", reason="signals")
    def test_ctrl_c_ends_it_as_it_ends_python(self, tmp_path):
        root = self.script(tmp_path, "import time\nprint('ready', flush=True)\ntime.sleep(60)\n")
        codes = []
        for command in (["-m", "legs_loss", "run", "train.py"], ["train.py"]):
            child = subprocess.Popen(
                [sys.executable, *command],
                cwd=str(root),
                env=legs_environment(),
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                universal_newlines=True,
            )
            assert child.stdout.readline() == "ready\n"
            time.sleep(0.1)
            child.send_signal(signal.SIGINT)
            _, errors = child.communicate(timeout=60)
            assert "KeyboardInterrupt" in errors
            codes.append(child.returncode)
        assert codes[0] == codes[1] != 0

    def test_modules_beside_the_script_are_rewritten_as_they_are_imported(self, tmp_path):
        texts = files("decoupled_appearance_weighted")
        texts["losses.py"] = texts["train.py"]
        texts["train.py"] = (
            "import inspect, losses\n"
            "from utils.loss_utils import l1_loss\n"
            "print(inspect.getsource(losses.training).count('legs_loss.l1_loss(') , legs_loss.__name__)\n"
        )
        root = checkout(tmp_path, texts)
        before = snapshot(root)
        done = by_python("-m", "legs_loss", "run", "train.py", cwd=root)
        assert done.returncode == 0, done.stderr
        assert done.stdout.splitlines()[0] == "2 legs_loss"
        assert snapshot(root) == before
        assert "losses.py:13 is weighted in this run" in done.stderr

    def test_calls_stay_plain_in_memory_too(self, tmp_path):
        texts = files("shared_loss_function_unweighted_call")
        texts["run.py"] = "import inspect, slam\nprint(inspect.getsource(slam.tracking), legs_loss.__name__)\n"
        root = checkout(tmp_path, texts)
        before = snapshot(root)
        done = by_python("-m", "legs_loss", "run", "run.py", cwd=root)
        assert done.returncode == 0, done.stderr
        assert "loss = legs_loss.unweighted(rgb_loss)(render(" in done.stdout
        assert "slam.py:7 is not weighted in this run" in done.stderr
        assert snapshot(root) == before

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["nowhere.py"], "nowhere.py is not a file"),
            (["plain.py"], "no photometric L1 term was found"),
            (["plain.py"], "; not read: latin.py: not UTF-8 (byte 28)"),
        ],
    )
    def test_what_cannot_be_run_is_one_line(self, arguments, message, tmp_path):
        (tmp_path / "plain.py").write_text("print('never')\n")
        (tmp_path / "latin.py").write_bytes("# -*- coding: latin-1 -*-\n# é\n".encode("latin-1"))
        done = legs("run", *arguments, cwd=str(tmp_path))
        assert done.returncode == 2
        assert done.stderr.startswith("legs: error: ")
        assert message in done.stderr
        assert done.stdout == ""

    def test_what_may_be_the_loss_is_offered_where_nothing_is_weighted(self, tmp_path):
        step = "def train_texture(image, gt_image):\n    l1_loss(image.depth, gt_image.depth).backward()\n"
        train = "from gaussian_renderer import render\n\n\n" + step
        settings = "loss:\n  weight: 1.0\n  type: l1\n"
        root = checkout(tmp_path, {"train.py": train, "configs/fox.yaml": settings})
        done = legs("run", "train.py", cwd=str(root))
        assert done.returncode == 2
        first, *rest = done.stderr.splitlines()
        assert first.endswith(f": if a skipped line is the loss, take it with legs-patch {root} --site train.py:5")
        assert [each.split(": ")[0] for each in rest] == ["configs/fox.yaml:3"]

    def test_a_term_that_may_be_the_loss_is_named_beside_one_that_is_weighted(self, tmp_path):
        other = "from utils.loss_utils import l1_loss\nimport gaussian_renderer\n\n\ndef step(image, gt, opt):\n"
        other += "    l1_loss(image, gt).backward()\n    print(opt.grad)\n"
        texts = {**files("runnable_train_script_weighted"), "other.py": other, "run.py": "print(1)\n"}
        root = checkout(tmp_path, texts)
        done = legs("run", "run.py", cwd=str(root))
        assert done.returncode == 0, done.stderr
        assert (
            "legs-loss: not weighted: other.py:6: nothing shows that this is the loss: No optimiser was" in done.stderr
        )
        assert "; if this is the loss: legs-patch --site other.py:6 takes your word" in done.stderr

    def test_a_mistyped_setting_is_one_line_before_the_script_starts(self, tmp_path):
        (tmp_path / "plain.py").write_text("print('never')\n")
        for variable, value, meant in (("LEGS_PRESET", "legz", "legs"), ("LEGS_CURVE", "C33", "C3")):
            done = legs("run", "plain.py", cwd=str(tmp_path), env=dict(legs_environment(), **{variable: value}))
            assert done.returncode == 2
            assert done.stderr.startswith(f"legs: error: environment variable {variable}: ")
            assert done.stderr.endswith(f"did you mean {meant!r}?\n")
            assert done.stdout == ""
