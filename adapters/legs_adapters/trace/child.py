"""Run a script watched, in a process of its own: one of ``--trace``, and each run of ``--verify``.

    python -m legs_adapters.trace.child '{"report": PATH, "root": CHECKOUT, ...}' train.py ARGUMENTS

What is recorded: every difference under a loss, the loss of every backward pass, what ``legs_loss.l1_loss`` counted.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any, Dict, Iterator, NamedTuple, Optional, Sequence

from legs_adapters.rewritten import call_when_spawned, execute, run_exit_functions
from legs_adapters.trace.command import Command, folders
from legs_loss.cli import exit_code
from legs_loss.system.locks import FileLock, is_held
from legs_loss.system.terminal import is_first_process

# No bytecode is written into the checkout; torch.compile and TorchScript cannot be watched.
_SETTINGS = {"PYTHONDONTWRITEBYTECODE": "1", "TORCHDYNAMO_DISABLE": "1", "PYTORCH_JIT": "0"}
# For runs that are compared; of two threads one may wait for its turn, and counts as work.
_THE_SAME = {"PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
_SECONDS = 1800  # that a run which is compared may take
_MOST_SAID = 1 << 16  # bytes of its stderr, the last ones, that are read


class Run(NamedTuple):
    """The record of one run.

    Attributes:
        code: its exit code.
        losses: the value of every loss that was trained on, as float.hex has it.
        seconds: of the processor, from each step to the next: other work does not change them much.
        weighted, plain: calls of legs_loss.l1_loss.
        stored, computed, remembered: where weight maps came from.
        terms: the differences under its losses, as `legs_adapters.terms.traced.Traced` reads them.
        error: the last lines of its stderr, where it was compared.
        is_over: whether it was ended because enough was seen.
        backward_passes: how many were seen; in words where the process left no report.
        unseen: the names of fused kernels under its losses.
        scripted: files and names of functions of TorchScript.
        failure: the first error in watching a difference.
    """

    code: int
    losses: Sequence[str] = ()
    seconds: Sequence[float] = ()
    weighted: int = 0
    plain: int = 0
    stored: int = 0
    computed: int = 0
    remembered: int = 0
    terms: Sequence[Dict[str, Any]] = ()
    error: str = ""
    is_over: bool = False
    backward_passes: Any = "by os._exit, exec or a kill: no"
    unseen: Sequence[str] = ()
    scripted: Sequence[Sequence[str]] = ()
    failure: str = ""

    @property
    def step(self) -> Optional[float]:
        """The seconds of the processor that a step takes, by the median; None without two steps."""
        return statistics.median(self.seconds) if self.seconds else None


def run_watched(
    root: Path,
    work: Path,
    command: Command,
    steps: int,
    cpu: bool,
    photos: Optional[str],
    compared: Optional[Dict[str, str]] = None,
) -> Run:
    """Run a command in a checkout, watched, until enough was seen.

    It ends with this process, and all that it started: if this one is killed, the script's finds the lock beside its
    report free, and deletes the work folder.

    Args:
        root: the checkout.
        work: of :func:`work_folder`.
        command: the script or module, its arguments, and a launcher, if any.
        steps: of an optimiser that moves what is rendered, after which the script is ended.
        cpu: run it with the shims, without a GPU.
        photos: the folder of the photographs, by the user's word.
        compared: of a run that is compared with others its environment variables: it starts from the same random
            numbers, says nothing, and has half an hour for as many backward passes of a loss as ``steps``. Variables of
            the user's that begin with LEGS_ are never passed on.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(_SETTINGS, **({"CUDA_VISIBLE_DEVICES": "", "OMP_WAIT_POLICY": "PASSIVE"} if cpu else {}))
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    report = Path(tempfile.mkdtemp(dir=str(work))) / "report.json"
    spec: Dict[str, Any] = {"report": str(report), "root": str(root), "work": str(work), "cpu": cpu}
    spec.update(folders=folders(root, command.arguments), photos=photos and os.path.abspath(photos))
    spec["limits"] = {"steps" if compared is None else "losses": steps}
    words = [*(command.launcher or [sys.executable]), "-m", "legs_adapters.trace.child", json.dumps(spec)]
    words += [*command.program, *command.arguments]
    streams: Dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": 2}
    with contextlib.ExitStack() as after:
        if compared is not None:
            environment.update(_THE_SAME, **compared)
            errors: Any = after.enter_context(tempfile.TemporaryFile())
            streams.update(stdout=subprocess.DEVNULL, stderr=errors)
        after.enter_context(FileLock(f"{report}.lock"))
        child = subprocess.Popen(words, cwd=str(root), env=environment, start_new_session=True, **streams)
        try:
            code = child.wait(None if compared is None else _SECONDS)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL) if os.name == "posix" else child.kill()
            child.wait()
        found = Run(code, error="" if compared is None else _last_lines(errors))
    try:
        return found._replace(**json.loads(report.read_text()))
    except (OSError, ValueError):  # it was killed
        return found


def _last_lines(file: Any) -> str:
    file.seek(max(0, file.seek(0, os.SEEK_END) - _MOST_SAID))
    return "\n".join(file.read().decode("utf-8", "replace").replace("\r", "\n").strip().splitlines()[-12:])


@contextlib.contextmanager
def work_folder(prefix: str) -> Iterator[Path]:
    """Make a temporary folder, and delete it at the end, also where that comes by SIGTERM or SIGHUP."""

    def leave(number: int, _: object) -> None:
        sys.exit(128 + number)

    with contextlib.ExitStack() as after:
        if threading.current_thread() is threading.main_thread():
            for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
                if signal.getsignal(number) is signal.SIG_DFL:
                    after.callback(signal.signal, number, signal.signal(number, leave))
        yield Path(after.enter_context(tempfile.TemporaryDirectory(prefix=prefix)))


def main(given: str, *words: str) -> int:
    """Run a script in this process, watched, and write the report to a file, also after an error."""
    import numpy as np
    import torch

    spec = json.loads(given)
    threading.Thread(target=_end_with_parent, args=(spec,), daemon=True).start()
    _watch(spec)
    if "losses" in spec["limits"]:  # runs are compared
        random.seed(0)
        np.random.seed(0)
        torch.manual_seed(0)
    return exit_code("legs", lambda: execute(words, {}, Path(spec["root"]) if spec["cpu"] else None))


def _end_with_parent(spec: Dict[str, Any]) -> None:
    """Wait until nobody holds the parent's lock; then delete what it left, and end all processes of the script."""
    lock = f"{spec['report']}.lock"
    while os.path.exists(lock) and is_held(lock):
        time.sleep(1.0)
    shutil.rmtree(spec["work"], ignore_errors=True)
    os.killpg(0, signal.SIGKILL) if os.name == "posix" else os._exit(1)


def _watch(spec: Dict[str, Any]) -> None:
    """Watch this process and those that it spawns, and write the report when it ends.

    Of several processes the one that saw steps writes it; of several of those rank 0.
    """
    from legs_adapters.trace.photographs import Photographs
    from legs_adapters.trace.watching import Watch

    def ended() -> None:
        watch.seen["is_over"] = True
        write()  # before Python 3.9 a spawned process forgets what it was to call at its end
        if spec.get("is_spawned") and os.name == "posix" and is_first_process():
            os.killpg(0, signal.SIGKILL)  # a rank that waits for one that has ended aborts, and the script would say so
        try:
            run_exit_functions()
        finally:
            os._exit(0)  # whatever the script would catch, and whatever threads of it are left

    def write() -> None:
        if is_first_process() and (watch.seen["steps"] or not os.path.exists(spec["report"])):
            seen = watch.report()
            Path(spec["report"]).write_text(json.dumps({name: seen[name] for name in Run._fields if name in seen}))

    watch = Watch(spec["root"], Photographs(spec["folders"], spec["photos"]), spec["limits"], ended)
    watch.install()
    Finalize(None, write, exitpriority=0)  # a process that multiprocessing starts has no atexit
    call_when_spawned(_watch, dict(spec, is_spawned=True))


if __name__ == "__main__":  # by its name: a process that the script spawns finds it by that
    sys.exit(importlib.import_module("legs_adapters.trace.child").main(*sys.argv[1:]))
