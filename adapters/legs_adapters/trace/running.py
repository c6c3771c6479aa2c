"""Run a command in its checkout with torch's differences watched, and read what was seen."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Dict, Iterator, Optional, Sequence, Tuple

from legs_adapters.terms.traced import Trace, Traced
from legs_adapters.trace.command import SCENE, filled, folders, parts
from legs_loss import LegsError
from legs_loss.system import FileLock, say

_SETTINGS = {  # no bytecode is written into the checkout; torch.compile and TorchScript cannot be watched
    "PYTHONDONTWRITEBYTECODE": "1", "TORCHDYNAMO_DISABLE": "1", "PYTORCH_JIT": "0",
}  # fmt: skip
_NOTHING: Dict[str, Any] = {"terms": [], "steps": 0, "unseen": [], "scripted": []}
_NOTHING["backward_passes"] = "by os._exit, exec or a kill: no"


def trace(root: Path, command: str, steps: int, cpu: bool = False, photos: Optional[str] = None) -> Trace:
    """Run a command in a checkout until that many steps were seen, and return what it compared.

    Args:
        root: the checkout, in which the command runs.
        command: the script and its arguments; `python` or a launcher like `torchrun` may stand before it.
        steps: of an optimiser that moves what is rendered.
        cpu: run it with the shims; where it names no folder that is there, on the embedded scene.
        photos: the folder of the photographs; default: those that the scenes' models list.

    Raises:
        SystemExit: the script failed, with its exit code; its traceback is on stderr already.
        LegsError: the command names no script; or nothing was trained.
    """
    launcher, script, arguments = parts(root, command)
    if photos is not None and not os.path.isdir(photos):
        raise LegsError(f"--photos {photos}: there is no such folder")
    with folder_for_runs("legs-trace-") as work:
        if cpu:
            from legs_adapters.shims.packages import check_imports
            from legs_loss.lab.embedded import write_embedded_scene

            check_imports(root, script)
            if not folders(root, arguments):
                places = {"scene": write_embedded_scene(work / "scene", **SCENE), "output": work / "output"}
                arguments += filled(root / script, None, arguments, 10 * steps, **places)
        say(f"legs-patch: running {script} in {root} for {steps} steps; it writes where it always does", sys.stderr)
        code, seen = run_watched(root, work, [script, *arguments], cpu, photos, {"steps": steps}, launcher, stdout=2)
    if code and not seen.get("is_over"):  # (a rank that waits for one that has ended fails)
        message = f"{script} ended with exit code {code}; nothing was changed. By reading: legs-patch {root}"
        say(f"legs-patch: error: {message}", sys.stderr)
        sys.exit(code if code > 0 else 128 - code)
    if seen.get("failure"):
        say(f"legs-patch: warning: a difference could not be watched ({seen['failure']})", sys.stderr)
    names = ", ".join(seen["unseen"])
    unseen = [f"a trace cannot look into fused kernels, as these under the loss: {names}"] if names else []
    terms = Traced.read(seen["terms"])
    if not terms:
        passes = f"{seen['backward_passes'] or 'no'} backward passes seen"
        message = f"{script} ended before an optimiser moved what it renders ({passes}): by reading: legs-patch {root}"
        raise LegsError(message, *unseen)
    for line in unseen if not any(term.is_photometric for term in terms) else ():
        say(f"legs-patch: warning: {line}", sys.stderr)
    return Trace(terms, frozenset(map(tuple, seen["scripted"])))


def run_watched(
    root: Path,
    work: Path,
    words: Sequence[str],
    cpu: bool,
    photos: Optional[str],
    limits: Dict[str, int],
    launcher: Sequence[str] = (),
    settings: Optional[Dict[str, str]] = None,
    **streams: Any,
) -> Tuple[int, Dict[str, Any]]:
    """Run a script in a checkout, watched, and return its exit code and the report of the process.

    It ends with this process, and all that it started: if this one is killed, the script's finds the lock beside its
    report free, and deletes the work folder.

    Args:
        root: the checkout.
        work: of :func:`folder_for_runs`.
        words: the script and its arguments.
        cpu: run it with the shims, without a GPU.
        photos: the folder of the photographs, by the user's word.
        limits: after how many "steps" or "losses" the script is ended.
        launcher: a program that starts it; default: this Python.
        settings: environment variables; those of the user's that begin with LEGS_ are not passed on.
        streams: further arguments of `subprocess.Popen`; and a "timeout" that ends the script with the code -1.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(_SETTINGS, **(settings or {}), **({"CUDA_VISIBLE_DEVICES": ""} if cpu else {}))
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    report, seconds = Path(tempfile.mkdtemp(dir=str(work))) / "report.json", streams.pop("timeout", None)
    spec: Dict[str, Any] = {"report": str(report), "root": str(root), "work": str(work), "cpu": cpu, "limits": limits}
    spec.update(folders=folders(root, words[1:]), photos=photos and os.path.abspath(photos))
    command = [*(launcher or [sys.executable]), "-m", "legs_adapters.trace.child", json.dumps(spec), *words]
    streams.update(cwd=str(root), env=environment, stdin=subprocess.DEVNULL, start_new_session=True)
    with FileLock(f"{report}.lock"):
        child = subprocess.Popen(command, **streams)
        try:
            code = child.wait(seconds)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL) if os.name == "posix" else child.kill()
            child.wait()
    try:
        return code, json.loads(report.read_text())
    except (OSError, ValueError):  # it was killed
        return code, _NOTHING


@contextlib.contextmanager
def folder_for_runs(prefix: str) -> Iterator[Path]:
    """Make a temporary folder, and delete it at the end, also where that comes by SIGTERM or SIGHUP."""

    def leave(number: int, _: object) -> None:
        sys.exit(128 + number)

    with contextlib.ExitStack() as after:
        if threading.current_thread() is threading.main_thread():
            for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
                if signal.getsignal(number) is signal.SIG_DFL:
                    after.callback(signal.signal, number, signal.signal(number, leave))
        yield Path(after.enter_context(tempfile.TemporaryDirectory(prefix=prefix)))
