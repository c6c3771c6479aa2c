"""A training codebase in the shape of the public ones, run end to end on the CPU, each run a process of its own."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from legs_loss.lab.embedded import write_embedded_scene
from tests import preloaded
from tests.patcher.support import checkout, snapshot
from tests.support import legs_environment

pytest.importorskip("numba")
pytest.importorskip("scipy")
pytest.importorskip("plyfile")

MINIATURE = Path(__file__).resolve().parent / "miniature.txt"


def texts():
    sections = re.split(r"^=== ", MINIATURE.read_text(encoding="utf-8"), flags=re.M)[1:]
    return {path.strip(): text for path, _, text in (section.partition("\n") for section in sections)}


def run(root, *arguments, cpu=True, **variables):
    environment = {name: value for name, value in legs_environment().items() if not name.startswith("LEGS_")}
    command = [sys.executable, "-m", "legs_loss", "run", *(["--cpu"] if cpu else []), *map(str, arguments)]
    return preloaded.run(command, cwd=root, env=dict(environment, **variables), timeout=600)


def result(done):
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_embedded_scene(tmp_path_factory.mktemp("scene"), views=5, width=64, height=48, points=500, samples=1)


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """The miniature, trained once with LEGS; its checkout, its stdout and its stderr."""
    root = checkout(tmp_path_factory.mktemp("miniature"), texts())
    before = snapshot(root)
    done = run(root, "train.py", "-s", scene, "-m", "out", "--checkpoint_iterations", "20")
    found = result(done)
    after = {name: data for name, data in snapshot(root).items() if not name.startswith("out")}
    assert after == before
    return root, found, done.stderr


class TestTraining:
    def test_it_learns_and_densifies(self, trained):
        _, found, _ = trained
        assert sum(found["l1"][-5:]) < 0.8 * sum(found["l1"][:5])
        assert found["ended"] > 1.2 * found["started"]
        assert found["ms"] > 0

    def test_it_is_weighted(self, trained):
        assert "train.py:35 is weighted in this run" in trained[2]
        assert "L1 weighted, preset legs" in trained[2]

    def test_what_it_saved_can_be_read(self, trained):
        from plyfile import PlyData

        root, found, _ = trained
        assert len(PlyData.read(str(root / "out" / "point_cloud.ply"))["vertex"].data) == found["ended"]

    @pytest.mark.slow
    def test_a_run_repeats(self, trained, scene):
        assert result(run(trained[0], "train.py", "-s", scene, "-m", "again"))["l1"] == trained[1]["l1"]

    def test_it_resumes_from_its_checkpoint(self, trained, scene):
        root, found, _ = trained
        more = result(run(root, "train.py", "-s", scene, "-m", "more", "--start_checkpoint", "out/chkpnt20.pth"))
        assert len(more["l1"]) == len(found["l1"]) - 20
        assert max(more["l1"]) < found["l1"][0]

    def test_it_renders_and_is_measured(self, trained, scene):
        root, _, _ = trained
        done = run(root, "render.py", "-s", scene, "-m", "out")
        assert done.returncode == 0, done.stderr
        measured = run(root, "metrics.py", "-s", scene, "-m", "out")
        found = result(measured)
        assert found["views"] == 5
        assert found["psnr"] > 15
        if found["lpips"] == "nan":
            assert measured.stderr.count("LPIPS is NaN") == 1

    @pytest.mark.slow
    @pytest.mark.skipif(importlib.util.find_spec("torchvision") is not None, reason="its networks may be had")
    def test_torchmetrics_measures_all_but_lpips(self, tmp_path):
        pytest.importorskip("torchmetrics")
        (tmp_path / "measure.py").write_text(MEASURE)
        done = run(tmp_path, "measure.py")
        found = result(done)
        assert found["psnr"] == pytest.approx(20)
        assert found["lpips"] == ["nan", "nan", "nan"]
        assert found["each"] == ["nan", "nan"]
        assert done.stderr.count("LPIPS is NaN") == 1


def renderer(old, new, text=None):
    """The miniature with one piece of its renderer replaced."""
    found = texts()
    source = text or found["gaussian_renderer/__init__.py"]
    assert old in source
    return dict(found, **{"gaussian_renderer/__init__.py": source.replace(old, new)})


@pytest.mark.slow
def errors(done):
    """Return the errors that a command ended with."""
    return [line for line in done.stderr.splitlines() if line.startswith("legs: error: ")]


class TestForks:
    """The same codebase with the rasterizers of others."""

    def train(self, root, scene, found, *arguments, iterations=6):
        done = run(checkout(root, found), "train.py", "-s", scene, "--iterations", str(iterations), *arguments)
        return result(done)["l1"], done.stderr

    @pytest.fixture(scope="class")
    def plain(self, scene, tmp_path_factory):
        return self.train(tmp_path_factory.mktemp("plain"), scene, texts())[0]

    def test_a_name_that_nobody_listed(self, plain, scene, tmp_path):
        found = renderer("diff_gaussian_rasterization", "diff_gaussian_rasterization_of_mine")
        assert self.train(tmp_path, scene, found)[0] == plain

    def test_results_go_by_their_names(self, plain, scene, tmp_path):
        found = renderer("rendered_image, radii =", "radii, rendered_depth, rendered_image, rendered_alpha =")
        found = renderer(
            "    return {",
            "    assert rendered_depth.shape == rendered_alpha.shape == (1,) + rendered_image.shape[1:]\n"
            "    assert 0 <= float(rendered_alpha.min()) and 0.1 < float(rendered_alpha.max()) <= 1\n"
            "    assert float(rendered_depth.max()) > 0.2\n"
            "    return {",
            found["gaussian_renderer/__init__.py"],
        )
        assert self.train(tmp_path, scene, found)[0] == plain

    def test_fastgs(self, plain, scene, tmp_path):
        found = renderer("diff_gaussian_rasterization", "diff_gaussian_rasterization_fastgs")
        text = found["gaussian_renderer/__init__.py"]
        for old, new in (
            ("debug=False,", "debug=False, mult=0.5, get_flag=True,\n        metric_map=torch.ones(48 * 64).int(),"),
            ("rendered_image, radii =", "rendered_image, radii, counts ="),
            ("shs=pc.get_features,", "dc=pc._features_dc,\n        shs=pc._features_rest,"),
            ("torch.zeros_like(pc.get_xyz, dtype", "torch.zeros((len(pc.get_xyz), 4), dtype"),
            ("    return {", "    assert counts.dtype == torch.int32 and int(counts.sum()) > 1000\n    return {"),
        ):
            text = renderer(old, new, text)["gaussian_renderer/__init__.py"]
        losses = self.train(tmp_path, scene, dict(found, **{"gaussian_renderer/__init__.py": text}))[0]
        assert losses != plain
        assert losses == pytest.approx(plain, rel=0.1)

    def test_taming(self, plain, scene, tmp_path):
        names = "counts, lists, listsRender, listsDistance, centers, depths, my_radii, weights, count, blend, distance"
        found = renderer("rendered_image, radii =", f"rendered_image, radii, {names} =")
        text = renderer(
            "debug=False,", "debug=False, pixel_weights=torch.ones(48, 64),", found["gaussian_renderer/__init__.py"]
        )
        text = renderer(
            "    return {",
            "    assert torch.equal(weights.int(), count) and int(count.sum()) > 1000\n"
            "    assert float(blend.max()) <= float(count.max())\n    return {",
            text["gaussian_renderer/__init__.py"],
        )
        assert self.train(tmp_path, scene, text)[0] == plain

    def test_a_result_that_is_not_known_is_an_error_only_where_it_is_used(self, plain, scene, tmp_path):
        found = renderer("rendered_image, radii =", "rendered_image, radii, out_flow =")
        assert self.train(tmp_path / "unused", scene, found)[0] == plain
        used = renderer("    return {", "    out_flow.mean()\n    return {", found["gaussian_renderer/__init__.py"])
        done = run(checkout(tmp_path / "used", used), "train.py", "-s", scene)
        assert done.returncode == 2
        assert errors(done) == [
            "legs: error: diff_gaussian_rasterization.GaussianRasterizer.forward's result 'out_flow' "
            "has no shim on the CPU"
        ]

    @pytest.mark.parametrize(
        ("old", "new", "named"),
        [
            ("debug=False,", "debug=False, mode=3,", "GaussianRasterizationSettings(mode=...)"),
            ("cov3D_precomp=None,", "theta=torch.zeros(3),", "GaussianRasterizer.forward(theta=...)"),
            ("GaussianRasterizer\n", "GaussianRasterizer, splat_4d\n", "diff_gaussian_rasterization.splat_4d"),
        ],
    )
    def test_what_would_change_the_picture_is_one_clear_error(self, old, new, named, scene, tmp_path):
        done = run(checkout(tmp_path, renderer(old, new)), "train.py", "-s", scene)
        assert done.returncode == 2
        (error,) = errors(done)
        assert error.startswith("legs: error: diff_gaussian_rasterization.")
        assert named in done.stderr
        assert "Traceback" not in done.stderr


class TestTheScriptIsNotBent:
    def test_arguments_and_names(self, trained, scene):
        assert trained[1]["argv"][:2] == ["-s", str(scene)]

    def test_without_cpu_nothing_is_redirected(self, tmp_path):
        found = dict(texts(), **{"look.py": LOOK})
        root = checkout(tmp_path, found)
        plain = json.loads(run(root, "look.py", cpu=False).stdout)
        assert plain == {"zeros": "builtin_function_or_method", "cpu": False, "knn": False}
        assert json.loads(run(root, "look.py").stdout) == {"zeros": "function", "cpu": True, "knn": True}

    @pytest.mark.skipif(os.name != "posix" or bool(shutil.which("nvidia-smi")), reason="the real one is asked")
    def test_a_script_that_asks_nvidia_smi_for_a_free_gpu_is_given_one(self, tmp_path):
        root = checkout(tmp_path, dict(texts(), **{"free.py": FREE}))
        done = run(root, "free.py")
        assert done.returncode == 3
        found = done.stdout.splitlines()
        assert found[:3] == ["[0]", "['memory.used [MiB]', '0 MiB', '']", "['0, 0', '']"]
        assert found[3] == "1  legs: error: nvidia-smi --gpu-reset has no shim on the CPU"

    @pytest.mark.slow
    @pytest.mark.parametrize("body", ["sys.exit(7)", "sys.exit('a message')", "raise RuntimeError('here')", "x = = 3"])
    def test_exit_codes_and_tracebacks_are_python_s(self, body, tmp_path):
        root = checkout(tmp_path, dict(texts(), **{"end.py": f"import sys\nprint('out', sys.argv)\n{body}\n"}))
        ours = run(root, "end.py", "-x", "--", "last")
        theirs = subprocess.run(
            [sys.executable, "end.py", "-x", "--", "last"],
            cwd=str(root), env=legs_environment(), capture_output=True, text=True,
        )  # fmt: skip
        assert (ours.returncode, ours.stdout) == (theirs.returncode, theirs.stdout)
        noise = [line for line in ours.stderr.splitlines() if not line.startswith("legs-loss: ")]
        assert noise == theirs.stderr.splitlines()

    @pytest.mark.slow
    def test_place_names_and_output_are_python_s(self, tmp_path):
        # From another folder than the script's, fed by a pipe, with a helper beside it, a thread that fails, and an
        # end that runs after the last line.
        root = checkout(
            tmp_path / "repo", dict(texts(), **{"tools/place.py": PLACE, "tools/helper.py": "HERE = __file__\n"})
        )
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        script = os.path.relpath(str(root / "tools" / "place.py"), str(elsewhere))
        found = []
        for command in (["-m", "legs_loss", "run", "--cpu"], []):
            done = subprocess.run(
                [sys.executable, *command, script, "--x=1", "a b", ""], input=b"first\nsecond\n", cwd=str(elsewhere),
                env=dict(legs_environment(), PYTHONWARNINGS="ignore"), capture_output=True,
            )  # fmt: skip
            errors = [line for line in done.stderr.decode().splitlines() if not line.startswith("legs-loss: ")]
            found.append((done.returncode, done.stdout, errors))
        assert found[0] == found[1]
        assert found[0][0] == 3
        assert found[0][1].endswith(b"at the end\n")

    @pytest.mark.skipif(os.name != "posix", reason="signals")
    def test_ctrl_c(self, tmp_path):
        root = checkout(tmp_path, dict(texts(), **{"wait.py": WAIT}))
        ends = []
        for command in (["-m", "legs_loss", "run", "--cpu", "wait.py"], ["wait.py"]):
            child = subprocess.Popen(
                [sys.executable, *command], cwd=str(root), env=legs_environment(), stdout=subprocess.PIPE,
                stderr=subprocess.PIPE, universal_newlines=True,
            )  # fmt: skip
            assert child.stdout.readline() == "ready\n"
            child.send_signal(signal.SIGINT)
            output, errors = child.communicate(timeout=60)
            noise = [line for line in errors.splitlines() if not line.startswith("legs-loss: ")]
            ends.append((child.returncode, output, noise))
        assert ends[0] == ends[1]
        assert ends[0][0] != 0
        assert ends[0][1] == "the thread\nat the end\n"
        assert ends[0][2][-1] == "KeyboardInterrupt"

    def test_a_codebase_without_a_loss_runs_too(self, tmp_path):
        (tmp_path / "alone.py").write_text("import torch\nprint(torch.ones(2, device='cuda').sum().item())\n")
        done = run(tmp_path, "alone.py")
        assert (done.returncode, done.stdout) == (0, "2.0\n")
        assert "nothing is weighted" in done.stderr


MEASURE = """
import json
import torch
import torchmetrics
from torchmetrics.functional.image import learned_perceptual_image_patch_similarity as lpips
from torchmetrics.image import LearnedPerceptualImagePatchSimilarity, PeakSignalNoiseRatio
first = torch.full((2, 3, 32, 32), 0.5, device="cuda")
second = first + 0.1
metric = torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True).to("cuda")
assert type(metric) is LearnedPerceptualImagePatchSimilarity
found = [metric(first, second), metric.compute(), lpips(first, second, net_type="vgg", normalize=True)]
each = LearnedPerceptualImagePatchSimilarity(reduction="none")(first, second)
psnr = PeakSignalNoiseRatio(data_range=1.0).to("cuda")(first, second)
print(json.dumps({"psnr": psnr.item(), "lpips": [str(x.item()) for x in found], "each": [str(x.item()) for x in each]}))
"""

FREE = """
import subprocess
import sys

def ask(command):
    done = subprocess.run(command, shell=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, universal_newlines=True)
    return done.returncode, done.stdout, done.stderr

used = ask("nvidia-smi -q -d Memory |grep -A4 GPU|grep Used")[1].split("\\n")
print([int(line.split()[2]) for line in used[:-1]])
print(ask("nvidia-smi --query-gpu=memory.used --format=csv")[1].split("\\n"))
print(ask("nvidia-smi --query-gpu=index,utilization.gpu --format=csv,noheader,nounits")[1].split("\\n"))
code, out, error = ask("nvidia-smi --gpu-reset")
print(code, out, error)
sys.exit(3)
"""

WAIT = """
import atexit
import threading
import time

stopped = threading.Event()
atexit.register(print, "at the end")
threading.Thread(target=lambda: (stopped.wait(), time.sleep(0.2), print("the thread"))).start()
# Said from beside, once the script sleeps: so that the traceback is always of the same line.
threading.Thread(target=lambda: (time.sleep(1), print("ready", flush=True))).start()
try:
    time.sleep(60)
finally:
    stopped.set()
"""

LOOK = """
import json
import torch
try:
    import simple_knn._C
    knn = True
except ImportError:
    knn = False
print(json.dumps({"zeros": type(torch.zeros).__name__, "cpu": torch.cuda.is_available(), "knn": knn}))
"""

PLACE = """
import atexit, os, sys, threading
import helper
atexit.register(print, "at the end")
print(sys.argv, os.getcwd(), __name__, __file__, os.path.realpath(sys.path[0]), helper.HERE)
print(__package__, sys.modules["__main__"].__dict__ is globals(), sys.stdout.isatty())
print(sys.stdin.readline(), sys.stdin.read())
os.write(1, bytes([0, 255, 10]))
sys.stderr.write("to stderr, no newline")
print(file=sys.stderr)

def fail():
    raise ValueError("in a thread")

thread = threading.Thread(target=fail, name="one")
thread.start()
thread.join()
sys.stdout.flush()
sys.exit(3)
"""
