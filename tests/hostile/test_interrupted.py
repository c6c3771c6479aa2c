"""legs train, compare and report, killed or interrupted before any operation on their files: a rerun completes.

What runs is a driver in a process of its own (this file as a script): it imports once, and forks for every point. An
audit hook counts what the commands open, rename, delete and make in their output folder, and acts at the n-th.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest

from tests.hostile.forked import forked
from tests.support import ROOT, legs_environment

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork") or not hasattr(sys, "addaudithook"), reason="needs fork, Python 3.8"),
    pytest.mark.slow,
]

EVENTS = ("open", "os.rename", "os.remove", "os.mkdir")
POINTS = 8  # of each command and signal, evenly; all of them are too many


@pytest.mark.parametrize("name", ["SIGKILL", "SIGINT"])
@pytest.mark.parametrize("what", ["train", "compare", "report"])
def test_at_many_points(what, name, tiny_scene, tmp_path):
    pytest.importorskip("numba")
    if what == "report":
        pytest.importorskip("matplotlib")
        pytest.importorskip("jinja2")
    done = subprocess.run(
        [sys.executable, __file__, what, name, str(tiny_scene), str(tmp_path)],
        env=legs_environment(), cwd=str(ROOT), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=1500,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout.decode()[-3000:]
    results = json.loads(done.stdout.decode().splitlines()[-1])
    assert len(results) >= 3
    assert {result["ended"] for result in results} <= {-signal.SIGKILL, 130, 0}, results
    assert any(result["ended"] for result in results)
    for result in results:
        assert "Traceback" not in result["said"], result
        assert result["rerun"] == 0, result
        assert result["same"], result
        assert not result["left"], result


def _fork(arguments, act=None, at=0, folder=""):
    """Run ``legs`` in a forked process that acts before its n-th operation; return its status, words and count."""
    seen = [0]

    def hook(event, found):
        if event in EVENTS and str(found[0]).startswith(folder) and _writes(event, found):
            seen[0] += 1
            if seen[0] == at:
                act()

    def command():
        sys.addaudithook(hook)
        from legs_loss.cli import main

        try:
            return main(arguments)
        finally:
            print(f"\noperations {seen[0]}", flush=True)

    status, said = forked(command)
    code = -(status & 127) if status & 127 else status >> 8
    return code, said, int(said.rpartition("operations ")[2].split()[0]) if "operations " in said else 0


def _writes(event, found):
    return event != "open" or bool(found[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))


def _in_this_process():
    """Train the arms of a comparison here, one after another: the operations of parent and children in one count."""
    from legs_loss.lab.experiments import running
    from legs_loss.lab.training.side_by_side import train_arm

    def train(arms, processes, on_progress, on_done, scheduler):
        for arm in arms:
            on_done(arm.name, train_arm(arm, lambda progress: None))

    running.train_side_by_side = train


def _result(out):
    """Return the results that must be the same however often it was interrupted: all but times."""
    found = {}
    for path in sorted(out.rglob("*")):
        if path.name == "point_cloud.ply":
            found[str(path.relative_to(out))] = path.read_bytes().hex()
        elif path.name == "report.html":
            page = path.read_text(encoding="utf-8")
            found[path.name] = (page.startswith("<!"), page.rstrip().endswith("</html>"), len(page) // 5000)
        elif path.name == "row.json":
            row = json.loads(path.read_text())
            found[str(path.relative_to(out))] = [row["config"], row["metrics"]["test"], row["metrics"]["gaussians"]]
    return found


def _drive(what, name, scene, folder):
    import shutil
    from pathlib import Path

    import matplotlib.figure  # noqa: F401
    import numba  # noqa: F401

    import legs_loss.lab.commands.compare
    import legs_loss.lab.report.html  # noqa: F401

    _in_this_process()
    folder, number = Path(folder), getattr(signal, name)

    def arguments(out):
        small = ["--iterations", "12", "-r", "2"]
        if what == "train":
            return ["train", scene, "--out", str(out), *small, "--threads", "1", "--checkpoint_every", "5"]
        if what == "compare":
            return ["compare", scene, "--out", str(out), *small, "--seeds", "1", "--arms", "legs"]
        return ["report", str(out)]

    def fresh(out):
        if what == "report":
            shutil.copytree(str(folder / "compared"), str(out))

    if what == "report":
        out = folder / "compared"
        code, said, _ = _fork(["compare", scene, "--out", str(out), "--iterations", "12", "-r", "2", "--seeds", "1",
                               "--arms", "legs"], folder=str(out))  # fmt: skip
        assert code == 0, said
        (out / "report.html").write_text("<!doctype html> of before </html>")
    whole = folder / "whole"
    fresh(whole)
    code, said, count = _fork(arguments(whole), folder=str(whole))
    assert (code, count > 1) == (0, True), said
    expected, results = _result(whole), []
    for at in range(1, count + 1, max(1, count // POINTS)):
        out = folder / str(at)
        fresh(out)
        ended, said, _ = _fork(arguments(out), lambda: os.kill(os.getpid(), number), at, str(out))
        page = out / "report.html"
        assert not page.exists() or page.read_text(encoding="utf-8").rstrip().endswith("</html>"), "half a page"
        for part in out.rglob("*.part"):  # as if it had been killed long ago; a young one may be a living writer's
            os.utime(str(part), (0, 0))
        again = arguments(out)
        if what == "train" and (out / "checkpoint.npz").exists():
            again = ["train", scene, "--out", str(out), "--resume", "--threads", "1", "--checkpoint_every", "5"]
        rerun, more, _ = _fork(again, folder=str(out))
        left = [str(path) for path in out.rglob("*.part")]
        same = _result(out) == expected
        results.append({"at": at, "ended": ended, "said": said + more, "rerun": rerun, "left": left, "same": same})
        shutil.rmtree(str(out))
    print(json.dumps(results))


if __name__ == "__main__":
    _drive(*sys.argv[1:])
