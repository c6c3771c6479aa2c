"""legs run, --trace and --verify, ended by a signal: no process goes on, no folder stays, the checkout is as it was."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("numba")

from legs_loss import LegsError
from tests.patcher.support import checkout, files, snapshot
from tests.support import legs_command, legs_environment

pytestmark = pytest.mark.skipif(os.name != "posix", reason="sends signals")

# In place of a training: a worker of its own, and time.
SLEEPS = """
import multiprocessing, os, sys, time
from utils.loss_utils import l1_loss


def work():
    print("worker", os.getpid(), file=sys.stderr, flush=True)
    time.sleep(300)


def training(render, cameras):
    for viewpoint_cam in cameras:
        image = render(viewpoint_cam)["render"]
        gt_image = viewpoint_cam.original_image.cuda()
        Ll1 = l1_loss(image, gt_image)
        Ll1.backward()


if __name__ == "__main__":
    open(os.environ["PIDS"], "a").write(f"{os.getpid()}\\n")
    worker = multiprocessing.get_context("fork").Process(target=work, daemon=True)
    worker.start()
    open(os.environ["PIDS"], "a").write(f"{worker.pid}\\n")
    time.sleep(300)
"""


def is_there(pid):
    """Return whether a process runs; one that has ended, and that nobody asks for, does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_for(what, seconds=120):
    until = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < until, "waited too long"
        time.sleep(0.1)


def test_a_traced_command_writes_into_the_copies(tmp_path):
    """Of --verify: a folder of the checkout by its whole path is that of each copy, and not the user's."""
    from legs_adapters.verify import check_verifiable

    root = checkout(tmp_path / "code", {**files("inria"), "data/a.txt": ""})
    (tmp_path / "scene").mkdir()
    (root / "linked").symlink_to(tmp_path / "scene")
    command = f"train.py -s ../scene --images=../scene -m {root}/out --model_path={root}/new/one data linked {root} x=1"
    given = check_verifiable(root, None, "", command, True).arguments
    scene = str(tmp_path / "scene")
    assert check_verifiable(root, None, "", f"{sys.executable} -u -m train -x {root}/out", True) == (
        [], ["-m", "train"], "train.py", ["-x", "out"],
    )  # fmt: skip
    assert given == ["-s", scene, f"--images={scene}", "-m", "out", "--model_path=new/one", "data", scene, ".", "x=1"]


def test_a_script_that_leaves_no_report(tmp_path):
    from legs_adapters.trace.tracing import trace

    root = checkout(tmp_path / "code", {"train.py": "import os\nos._exit(0)\n"})
    with pytest.raises(LegsError, match=r"by os\._exit, exec or a kill: no backward passes seen"):
        trace(root, "train.py", 5)


LOUD = "import sys\nfor _ in range(100):\n    sys.stderr.write('x' * 999_999 + '\\n')\nsys.exit('at last')\n"


def test_of_100_megabytes_on_stderr_the_end_is_read(tmp_path):
    import tracemalloc

    from legs_adapters.trace import child
    from legs_adapters.trace.command import Command

    root = checkout(tmp_path / "code", {"train.py": LOUD})
    tracemalloc.start()
    try:
        run = child.run_watched(root, tmp_path, Command([], ["train.py"], "train.py", []), 1, False, None, {})
        assert tracemalloc.get_traced_memory()[1] < 20 << 20
    finally:
        tracemalloc.stop()
    assert (run.code, run.error[-7:], len(run.error) <= 1 << 16) == (1, "at last", True)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="asks /proc which processes run")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "name"),
    [
        ("run --cpu", "SIGTERM"),
        ("trace", "SIGKILL"),
        ("trace", "SIGHUP"),
        ("trace by torchrun", "SIGKILL"),
        ("trace by torchrun", "SIGINT"),
        ("verify", "SIGKILL"),
        ("verify", "SIGTERM"),
    ],
)
def test_it_ends_with_all_that_it_started(what, name, tmp_path):
    number = getattr(signal, name)
    root = checkout(tmp_path / "code", {**files("inria"), "train.py": SLEEPS})
    temporary, pids = tmp_path / "tmp", tmp_path / "pids"
    temporary.mkdir()
    environment = dict(legs_environment(), TMPDIR=str(temporary), PIDS=str(pids))
    patch = [sys.executable, "-m", "legs_adapters.cli"]
    torchrun = f"{sys.executable} -m torch.distributed.run --standalone --nproc_per_node 2 train.py"
    command = {
        "run --cpu": [*legs_command("run", "--cpu"), "train.py"],
        "trace": [*patch, "--trace", "train.py", "."],
        "trace by torchrun": [*patch, "--trace", torchrun, "."],
        "verify": [*patch, "--verify", "--arguments", "", "."],
    }[what]
    before = snapshot(root)
    wanted = 4 if "torchrun" in what else 2
    with subprocess.Popen(command, cwd=str(root), env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                          start_new_session=True) as process:  # fmt: skip
        try:
            wait_for(lambda: pids.exists() and len(pids.read_text().split()) == wanted)
            os.kill(process.pid, number)
            process.wait(60)
            started = [int(pid) for pid in pids.read_text().split()]
            if what == "run --cpu":  # the script is this process, and what it starts its own, as by Python
                started = [process.pid]
            wait_for(lambda: not any(is_there(pid) for pid in started))
        finally:
            for pid in pids.read_text().split():
                if is_there(int(pid)):
                    os.kill(int(pid), signal.SIGKILL)
        said = process.stdout.read().decode()
    assert process.returncode in (-number, 128 + number), said
    assert process.returncode > 0 or number == signal.SIGKILL or what == "run --cpu", "not by its own exit"
    if what in ("trace", "verify"):  # torchrun has one of its own
        assert "Traceback" not in said
    wait_for(lambda: not list(temporary.glob("legs*")))  # torch and torchrun leave some of their own
    if what == "verify":
        assert subprocess.run([*patch, "--undo", str(root)], env=environment, stdout=subprocess.DEVNULL).returncode == 0
    assert snapshot(root) == before
    assert not [path for path in root.iterdir() if path.name.startswith(".legs-patch")]
