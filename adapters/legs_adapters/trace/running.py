"""Run a command in its checkout with torch's differences watched, and read what was seen."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

from legs_adapters.terms.traced import Trace, Traced
from legs_adapters.trace.command import SCENE, filled, folders, parts
from legs_loss import LegsError
from legs_loss.system import say

__all__ = ["ScriptFailed", "run_watched", "trace"]

_SETTINGS = {  # no bytecode is written into the checkout; torch.compile and TorchScript cannot be watched
    "PYTHONDONTWRITEBYTECODE": "1", "TORCHDYNAMO_DISABLE": "1", "PYTORCH_JIT": "0",
}  # fmt: skip
_NOTHING: Dict[str, Any] = {"terms": [], "steps": 0, "backward_passes": 0, "unseen": [], "scripted": []}


class ScriptFailed(LegsError):
    """The traced script failed; its traceback is on stderr already. ``code`` is its exit code."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


def trace(root: Path, command: str, steps: int, cpu: bool = False, photos: Optional[str] = None) -> Trace:
    """Run a command in a checkout until that many steps were seen, and return what it compared.

    Args:
        root: the checkout, in which the command runs.
        command: the script and its arguments; `python` or a launcher like `torchrun` may stand before it.
        steps: of an optimiser that moves what is rendered.
        cpu: run it with the shims; where it names no folder that is there, on the embedded scene.
        photos: the folder of the photographs; default: those that the scenes' models list.

    Raises:
        ScriptFailed: the script did.
        LegsError: the command names no script; or nothing was trained.
    """
    launcher, script, arguments = parts(root, command)
    if photos is not None and not os.path.isdir(photos):
        raise LegsError(f"--photos {photos}: there is no such folder")
    with tempfile.TemporaryDirectory(prefix="legs-trace-") as work:
        if cpu:
            from legs_adapters.shims.packages import check_imports
            from legs_loss.lab.embedded import write_embedded_scene

            check_imports(root, script)
            if not folders(root, arguments):
                places = {"scene": write_embedded_scene(Path(work) / "scene", **SCENE), "output": Path(work) / "output"}
                arguments += filled(root / script, None, arguments, 10 * steps, **places)
        say(f"legs-patch: running {script} in {root} for {steps} steps; it writes where it always does", sys.stderr)
        code, seen = run_watched(root, [script, *arguments], cpu, photos, {"steps": steps}, launcher, stdout=2)
    if code and not seen.get("is_over"):  # (a rank that waits for one that has ended fails)
        message = f"{script} ended with exit code {code}; nothing was changed. By reading: legs-patch {root}"
        raise ScriptFailed(message, code if code > 0 else 128 - code)
    if seen.get("failure"):
        say(f"legs-patch: warning: a difference could not be watched ({seen['failure']})", sys.stderr)
    names = ", ".join(seen["unseen"])
    unseen = [f"a trace cannot look into fused kernels, as these under the loss: {names}"] if names else []
    terms = Traced.read(seen["terms"])
    if not terms:
        passes = f"{seen['backward_passes']} backward passes" if seen["backward_passes"] else "no backward pass"
        raise LegsError(
            f"{script} ended before an optimiser moved what it renders ({passes} seen): by reading: legs-patch {root}",
            *unseen,
        )
    for line in unseen if not any(term.is_photometric for term in terms) else ():
        say(f"legs-patch: warning: {line}", sys.stderr)
    return Trace(terms, seen["steps"], frozenset(map(tuple, seen["scripted"])))


def run_watched(
    root: Path,
    words: Sequence[str],
    cpu: bool,
    photos: Optional[str],
    limits: Dict[str, int],
    launcher: Sequence[str] = (),
    settings: Optional[Dict[str, str]] = None,
    **streams: Any,
) -> Tuple[int, Dict[str, Any]]:
    """Run a script in a checkout, watched, and return its exit code and the report of the process.

    Args:
        root: the checkout.
        words: the script and its arguments.
        cpu: run it with the shims, without a GPU.
        photos: the folder of the photographs, by the user's word.
        limits: after how many "steps" or "losses" the script is ended.
        launcher: a program that starts it; default: this Python.
        settings: environment variables; those of the user's that begin with LEGS_ are not passed on.
        streams: further arguments of `subprocess.run`, whose time limit ends the script with the code -1.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(_SETTINGS, **(settings or {}), **({"CUDA_VISIBLE_DEVICES": ""} if cpu else {}))
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    with tempfile.TemporaryDirectory(prefix="legs-trace-") as work:
        report = Path(work) / "report.json"
        spec = {"report": str(report), "root": str(root), "cpu": cpu, "folders": folders(root, words[1:]), **limits}
        spec["photos"] = photos and os.path.abspath(photos)
        command: List[str] = [*(launcher or [sys.executable]), "-m", "legs_adapters.trace.child", json.dumps(spec)]
        try:
            done = subprocess.run(
                [*command, *words], cwd=str(root), env=environment, stdin=subprocess.DEVNULL, **streams
            )
            code = done.returncode
        except subprocess.TimeoutExpired:
            code = -1
        try:
            return code, json.loads(report.read_text())
        except (OSError, ValueError):  # it was killed
            return code, _NOTHING
