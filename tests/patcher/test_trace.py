"""legs-patch --trace: what a run of the training script shows decides, on losses that cannot be read off the text."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.patcher.support import legs_patch, snapshot
from tests.patcher.traced import write, write_scene
from tests.patcher.ways import UNSEEN, WAYS
from tests.support import legs_environment

pytestmark = pytest.mark.slow

LOOP = """
for step in range(100):
    camera = views[step % len(views)]
    gt_image = camera.values["images"]
"""
END = """
    loss.backward()
    splats.optimizer.step()
    splats.optimizer.zero_grad()
"""


def body(*lines, head=""):
    """Return a training script: these lines between the camera and the backward pass."""
    return head + LOOP + "".join(f"    {line}\n" for line in lines) + END


def traced(tmp_path, train, *options, steps=8, scene=None, before="", **more):
    """Trace a codebase with this train.py; return the report, and the line that must be weighted."""
    scene = scene or write_scene(tmp_path / "scene")
    line = write(tmp_path / "code", train, **more)
    command = f"{before}train.py -s {scene}"
    before = snapshot(tmp_path / "code")
    done = legs_patch("--trace", command, "--json", "--check", "--steps", str(steps), *options, tmp_path / "code")
    assert done.stdout, done.stderr
    assert snapshot(tmp_path / "code") == before  # nothing is written, no bytecode either
    return json.loads(done.stdout), line, done


def weighted(report):
    return [(site["file"], site["line"]) for site in report["sites"]]


CASES = {
    "called by its name": body('image = splats.draw(camera)["rgb"]', "loss = F.l1_loss(image, gt_image)  # <- here"),
    "losses from a dictionary": body(
        'image = splats.draw(camera)["rgb"]',
        'loss = LOSSES["l" + "1"](image, gt_image)  # <- here',
        head="def absolute(a, b):\n    return (a - b).abs().mean()\n\n\nLOSSES = {'l1': absolute, 'l2': F.mse_loss}\n",
    ),
    "losses from a dictionary in a loop": body(
        'image = splats.draw(camera)["rgb"]',
        "loss = sum(LOSSES[name](image, gt_image) for name in ('l1', 'l2'))",
        head="def absolute(a, b):\n    return (a - b).abs().mean()  # <- here\n\n\n"
        "LOSSES = {'l1': absolute, 'l2': F.mse_loss}\n",
    ),
    "names that say nothing, target first": body(
        'x = splats.draw(camera)["rgb"]',
        "loss = torch.abs(gt_image[None] * 1.0 - x[None]).mean()  # <- here",
    ),
    "normals stored as pictures": body(
        "drawn = splats.draw(camera)",
        'loss = F.l1_loss(drawn["rgb"], gt_image)  # <- here',
        'target = camera.values["normals"]',
        'loss = loss + 0.1 * F.l1_loss(drawn["normal"], target)',
    ),
    "a teacher's rendering": body(
        'image = splats.draw(camera)["rgb"]',
        'with torch.no_grad():\n        gt = teacher.draw(camera)["rgb"]',
        "loss = F.l1_loss(image, gt_image)  # <- here",
        "loss = loss + 0.2 * F.l1_loss(image, gt)",
        head="teacher = Splats(90)\n",
    ),
    "features": body(
        'image = splats.draw(camera)["rgb"]',
        "loss = F.l1_loss(image, gt_image)  # <- here",
        "image, target = net(image[None]), net(gt_image[None]).detach()",
        "loss = loss + 0.2 * F.l1_loss(image, target)",
        head="net = torch.nn.Conv2d(3, 8, 3)\n",
    ),
    "a term that begins later": body(
        'image = splats.draw(camera)["rgb"]',
        "loss = F.mse_loss(image, gt_image)",
        "if step >= 4:",
        "    loss = F.l1_loss(image, gt_image)  # <- here",
    ),
    "a photograph that is called a depth": body(
        "drawn, depth = splats.draw(camera), gt_image",
        'loss = compare(drawn["rgb"], gt_image) + 0.5 * compare(drawn["normal"], gt_image)',
        'loss = loss + 0.1 * compare(drawn["normal"], depth)',
        head="def compare(a, b):\n    return (a * 1.0 - b).abs().mean()  # <- here\n",
    ),
    "channels last, resized, in a batch": body(
        'image = splats.draw(camera)["rgb"]',
        "small = [F.interpolate(x[None], scale_factor=0.75, mode='area') for x in (image, gt_image)]",
        "small = [each.permute(0, 2, 3, 1) for each in small]",
        "loss = F.l1_loss(small[0], small[1])  # <- here",
    ),
}


class TestWhichTerm:
    @pytest.mark.parametrize("name", sorted(CASES))
    def test_the_photographs_line_and_no_other(self, tmp_path, name, monkeypatch):
        report, line, done = traced(tmp_path, CASES[name])
        assert (weighted(report), report["plain"]) == ([line], []), done.stderr
        known = [term for term in report["traced"] if term["is_photometric"]]
        assert known and all(term["image"]["path"].startswith("images") for term in known)
        assert all(term["gaussians"] == 150 and term["parameters"] for term in known)

    def test_an_absolute_value_in_place_has_its_share(self, tmp_path):
        lines = body('image = splats.draw(camera)["rgb"]', "loss = (image - gt_image).abs_().mean()  # <- here")
        report, line, done = traced(tmp_path, lines)
        assert weighted(report) == [line], done.stderr
        assert [round(term["share"], 3) for term in report["traced"] if term["is_photometric"]] == [1.0]

    def test_a_list_of_pixels_is_quoted_and_never_written(self, tmp_path):
        picked = ("image = image[:, ys, xs]", "gt_image = gt_image[:, ys, xs]", "loss = F.l1_loss(image, gt_image)")
        head = "ys, xs = torch.randint(0, 16, (2, 500))\n"
        report, _, done = traced(tmp_path, body('image = splats.draw(camera)["rgb"]', *picked, head=head))
        assert (done.returncode, report["sites"]) == (2, [])
        assert "100% of the loss; gt_image is no photograph (a list of pixels or points: 3x500)" in done.stderr
        assert "weight the L1 of the whole images, before pixels are picked or flattened" in done.stderr

    def test_a_list_of_pixels_that_reading_does_not_know_is_said(self, tmp_path):
        lines = "drawn, photo = image.reshape(3, -1), gt_image.reshape(3, -1)", "parts = {}", "parts[0] = drawn - photo"
        lines = *lines, "loss = sum(part.abs().mean() for part in parts.values())"
        report, _, done = traced(tmp_path, body('image = splats.draw(camera)["rgb"]', *lines))
        (left,) = report["left"]
        assert (done.returncode, left["code"]) == (2, lines[2])
        assert left["reason"].startswith("100% of the loss; photo is no photograph (a list of pixels or points: 3x")

    def test_one_loop_for_colour_and_depth_is_quoted(self, tmp_path):
        lines = body(
            "drawn, loss = splats.draw(camera), 0",
            'targets = {"rgb": gt_image, "depth": gt_image[:1]}',
            "for key in targets:",
            "    loss = loss + (drawn[key] - targets[key]).abs().mean()  # <- here",
        )
        report, line, done = traced(tmp_path, lines)
        assert weighted(report) == []
        assert [(each["file"], each["line"]) for each in report["problems"]] == [line]
        assert "serves other terms of the trace, too" in done.stderr

    @pytest.mark.skipif(sys.version_info < (3, 11), reason="a stack has no columns")
    def test_of_a_line_of_two_the_one_that_ran_is_weighted(self, tmp_path):
        lines = body(
            'drawn, normals, factor = splats.draw(camera), camera.values["normals"], 0.0',
            'loss = F.l1_loss(drawn["normal"], normals) if factor else F.l1_loss(drawn["rgb"], gt_image)  # <- here',
        )
        report, line, _ = traced(tmp_path, lines)
        assert weighted(report) == [line] and report["sites"][0]["code"] == 'F.l1_loss(drawn["rgb"], gt_image)'

    def test_tracking_and_mapping_through_one_function(self, tmp_path):
        train = """
        def compare(a, b):
            return (a * 1.0 - b).abs().mean()  # <- here


        def follow(camera):
            image = splats.draw(camera)["rgb"]
            loss = compare(image, camera.values["images"])
            loss.backward()
            moves.step()
            moves.zero_grad()


        def improve(camera):
            image = splats.draw(camera)["rgb"]
            loss = compare(image, camera.values["images"])
            loss.backward()
            splats.optimizer.step()
            splats.optimizer.zero_grad()


        moves = torch.optim.Adam([view.pose for view in views], lr=1e-3)
        for step in range(100):
            for leaf in (splats.xy, splats.colour, splats.opacity):
                leaf.requires_grad_(False)
            follow(views[step % 6])
            for leaf in (splats.xy, splats.colour, splats.opacity):
                leaf.requires_grad_(True)
            improve(views[step % 6])
        """
        report, line, done = traced(tmp_path, train)
        text = (tmp_path / "code" / "train.py").read_text().splitlines()
        tracking = next(at for at, line in enumerate(text, 1) if "compare(image" in line)
        assert weighted(report) == [line], done.stderr
        assert [each["line"] for each in report["plain"]] == [tracking]

    def test_a_squared_loss_of_a_photograph_is_said(self, tmp_path):
        train = body('image = splats.draw(camera)["rgb"]', "loss = F.mse_loss(image, gt_image)  # <- here")
        report, line, _ = traced(tmp_path, train)
        assert weighted(report) == []
        assert [each["line"] for each in report["left"]] == [line[1]]
        assert "is images/00" in report["left"][0]["reason"] and "a squared loss, no L1" in report["left"][0]["reason"]


class TestWaysToTrain:
    @pytest.mark.parametrize("name", WAYS)
    def test_the_photographs_line_and_no_other(self, tmp_path, name, monkeypatch):
        train, modules = WAYS[name]
        for module in modules:
            pytest.importorskip(module)
        # Beside this Python, whose environment need not be activated.
        monkeypatch.setenv("PATH", os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]]))
        if name == "torchrun" and shutil.which("torchrun") is None:
            pytest.skip("torchrun is not installed beside this Python")
        before = "torchrun --nproc_per_node 2 --master_port 29547 " if name == "torchrun" else ""
        report, line, done = traced(tmp_path, train, before=before, steps=4)
        assert weighted(report) == [line], done.stderr
        assert "Traceback" not in done.stderr

    def test_as_a_module(self, tmp_path):
        """`python -m package.train`: imports of the package, and of what lies beside it."""
        scene, root = write_scene(tmp_path / "scene"), tmp_path / "code"
        write(root, body('image = splats.draw(camera)["rgb"]', "loss = compare(image, gt_image)"))
        (root / "package").mkdir()
        text = (root / "train.py").read_text(encoding="utf-8")
        (root / "package/train.py").write_text(f"from .losses import compare\n{text}", encoding="utf-8")
        (root / "train.py").unlink()
        losses = "def compare(a, b):\n    return (a - b).abs().mean()\n"
        (root / "package/losses.py").write_text(losses, encoding="utf-8")
        done = legs_patch("--trace", f"-m package.train -s {scene}", "--json", "--check", "--steps", "4", root)
        assert done.stdout, done.stderr
        report = json.loads(done.stdout)
        lines = (root / "package/train.py").read_text(encoding="utf-8").splitlines()
        assert weighted(report) == [("package/train.py", lines.index("    loss = compare(image, gt_image)") + 1)]

    def test_a_fused_loss_is_said(self, tmp_path):
        report, line, done = traced(tmp_path, UNSEEN)
        assert weighted(report) == []
        fused = [each["reason"] for each in report["left"] if each["line"] == line[1]]
        assert len(fused) == 1 and "compiled: Fused, not looked into" in fused[0]
        assert "a trace cannot look into fused kernels, as these under the loss: FusedBackward" in done.stderr

    def test_a_distance_is_said(self, tmp_path):
        report, line, _ = traced(
            tmp_path, body('loss = torch.dist(splats.draw(camera)["rgb"], gt_image, p=1)  # <- here')
        )
        reasons = [each["reason"] for each in report["left"] if each["line"] == line[1]]
        assert weighted(report) == [] and len(reasons) == 1
        assert reasons[0].endswith("gt_image is images/000.png; distance: of any norm, not looked into")

    def test_nothing_of_a_step_is_kept(self, tmp_path):
        """Tensors alive after each step, by the script's own count; parameters are replaced, one is never stepped."""
        train = body(
            "drawn = splats.draw(camera)",
            "loss = F.l1_loss(drawn['rgb'] + 0 * idle.sum(), gt_image)  # <- here",
            "loss = loss + 0.1 * (drawn['depth'] - gt_image[:1]).abs().mean()",
            "loss = loss + (drawn['rgb'] - 0.5 * gt_image).square().mean()",
            head="import gc\nimport weakref\n\n"
            "idle, counts, replaced = torch.nn.Parameter(torch.zeros(64, 3)), [], []\n",
        )
        train += """
    if step % 5 == 4:
        replaced += [weakref.ref(splats.xy), weakref.ref(idle)]
        idle, fresh = torch.nn.Parameter(torch.zeros(64, 3)), torch.nn.Parameter(splats.xy.detach().clone())
        del splats.optimizer.state[splats.xy]
        splats.xy = splats.optimizer.param_groups[0]["params"][0] = fresh
        del fresh
    del drawn, loss
    gc.collect()
    counts.append(sum(isinstance(each, torch.Tensor) for each in gc.get_objects()))
    if step == 29:
        print("alive", counts[5::5], sum(each() is not None for each in replaced[:-2]), flush=True)
"""
        _, _, done = traced(tmp_path, train, steps=31)
        alive = next(line for line in done.stderr.splitlines() if line.startswith("alive"))
        counts, kept = json.loads(alive[6 : alive.index("]") + 1]), int(alive.split()[-1])
        assert len(counts) == 5 and len(set(counts)) == 1, alive
        assert kept == 0, alive


class TestHarmless:
    def test_a_script_that_fails_keeps_its_traceback_and_exit_code(self, tmp_path):
        scene = write_scene(tmp_path / "scene")
        write(tmp_path / "code", "raise SystemExit(7)\n")
        done = legs_patch("--trace", f"train.py -s {scene}", tmp_path / "code")
        assert done.returncode == 7
        write(tmp_path / "other", "1 / 0\n")
        done = legs_patch("--trace", f"train.py -s {scene}", tmp_path / "other")
        assert done.returncode == 1
        assert done.stderr.count("ZeroDivisionError") == 1
        assert "By reading: legs-patch" in done.stderr

    def test_a_script_without_a_step(self, tmp_path):
        scene = write_scene(tmp_path / "scene")
        write(tmp_path / "code", "print(len(views))\n")
        done = legs_patch("--trace", f"train.py -s {scene}", tmp_path / "code")
        assert done.returncode == 2
        assert "ended before an optimiser moved what it renders" in done.stderr

    def test_usage(self, tmp_path):
        write(tmp_path / "code", "pass\n")
        for options, message in [
            (["--trace", "train"], "names no script"),
            (["--trace", "-m package.train -s x"], "names no script, and no module"),
            (["--trace", "other.py -s x"], "there is no other.py"),
            (["--trace", "train.py", "--steps", "0"], "--steps must be at least 1"),
            (["--trace", "train.py", "--photos", "nowhere"], "there is no such folder"),
            (["--cpu"], "belong to --trace"),
        ]:
            done = legs_patch(*options, tmp_path / "code")
            assert done.returncode == 2 and message in done.stderr, done.stderr

    @pytest.mark.skipif(os.name != "posix", reason="sends a signal")
    def test_ctrl_c_ends_both(self, tmp_path):
        scene = write_scene(tmp_path / "scene")
        write(tmp_path / "code", "import time, os\nprint('pid', os.getpid(), flush=True)\ntime.sleep(60)\n")
        command = [sys.executable, "-m", "legs_adapters.cli", "--trace", f"train.py -s {scene}", str(tmp_path / "code")]
        process = subprocess.Popen(
            command,
            env=legs_environment(),
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        pid = next(int(line.split()[1]) for line in process.stderr if line.startswith("pid"))
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(timeout=30) in (130, -signal.SIGINT)
        for _ in range(100):
            try:
                os.kill(pid, 0)
            except ProcessLookupError:
                return
            time.sleep(0.1)
        pytest.fail("the script runs on")
