"""Run a command in its checkout with torch's differences watched, and read what was seen."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Dict, List, Optional, Sequence, Tuple

from legs_adapters.terms.traced import Trace, Traced
from legs_adapters.trace.photographs import SURE
from legs_loss import LegsError
from legs_loss.system import say

__all__ = ["CHILD", "ScriptFailed", "child_environment", "trace"]

CHILD = "legs_adapters.trace.child"


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
    before, script, arguments = _parts(root, command)
    with tempfile.TemporaryDirectory(prefix="legs-trace-") as work:
        folders = _folders(root, arguments)
        if cpu and not folders:
            from legs_adapters.verify import embedded_arguments

            arguments += embedded_arguments(root / script, arguments, Path(work), 10 * steps)
            folders = _folders(root, arguments)
        if photos is not None and not os.path.isdir(photos):
            raise LegsError(f"--photos {photos}: there is no such folder")
        report = Path(work) / "report.json"
        spec: Dict[str, Any] = {"report": str(report), "root": str(root), "cpu": cpu, "steps": steps}
        spec.update(folders=folders, photos=photos and os.path.abspath(photos))
        if cpu:
            from legs_adapters.shims.packages import check_imports

            check_imports(root, script)
        say(f"legs-patch: running {script} in {root} for {steps} steps; it writes where it always does", sys.stderr)
        eager = {"TORCHDYNAMO_DISABLE": "1", "PYTORCH_JIT": "0"}  # torch.compile and TorchScript cannot be watched
        words = [*(before or [sys.executable]), "-m", CHILD, json.dumps(spec), script, *arguments]
        code = subprocess.run(
            words, cwd=str(root), env=child_environment(cpu, **eager), stdout=2, stdin=subprocess.DEVNULL
        ).returncode
        content = _read(report)
    if code and not content.get("is_over"):  # (a rank that waits for one that has ended fails)
        message = f"{script} ended with exit code {code}; nothing was changed. By reading: legs-patch {root}"
        raise ScriptFailed(message, code if code > 0 else 128 - code)
    if content.get("failure"):
        say(f"legs-patch: warning: a difference could not be watched ({content['failure']})", sys.stderr)
    terms = [Traced.read(term, SURE) for term in content["terms"]]
    if not content["steps"]:
        seen = f"{content['backward_passes']} backward passes" if content["backward_passes"] else "no backward pass"
        raise LegsError(
            f"{script} ended before an optimiser moved what it renders ({seen} seen): by reading: legs-patch {root}",
            *_unseen(content["unseen"]),
        )
    known = [term for term in terms if term.steps or term.poses]
    if not any(term.is_photometric for term in known):
        for line in _unseen(content["unseen"]):
            say(f"legs-patch: warning: {line}", sys.stderr)
    return Trace(known, content["steps"], frozenset(map(tuple, content["scripted"])))


def _unseen(names: Sequence[str]) -> List[str]:
    return [f"a trace cannot look into fused kernels, as these under the loss: {', '.join(names)}"] if names else []


def child_environment(cpu: bool, **settings: str) -> Dict[str, str]:
    """Return the environment of a watched process: legs-patch's packages, no bytecode written into the checkout."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(PYTHONDONTWRITEBYTECODE="1", **settings)
    if cpu:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return environment


def _parts(root: Path, command: str) -> Tuple[List[str], str, List[str]]:
    """Return what stands before the script (nothing for python itself), the script, and its arguments."""
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise LegsError(f"--trace {command!r}: {error}") from None
    at = next((i for i, word in enumerate(words) if word.endswith(".py")), None)
    if at is None:
        raise LegsError(f'--trace {command!r} names no script: --trace "train.py -s SCENE"')
    if not (root / words[at]).is_file():
        raise LegsError(f"--trace: there is no {words[at]} in {root}")
    before = [word for word in words[:at] if word != "-m"]
    is_python = all(os.path.basename(word).startswith("python") or word == "-u" for word in before)
    return [] if is_python else before, words[at], words[at + 1 :]


def _folders(root: Path, arguments: Sequence[str]) -> List[str]:
    """Return the folders that a command's words name, the outermost only; not the checkout itself, nor one of it."""
    named = [word.partition("=")[2] if word.startswith("-") else word for word in arguments]
    paths = [os.path.realpath(str(root / word)) for word in named if word]
    found = [path for path in dict.fromkeys(paths) if os.path.isdir(path) and path != os.path.realpath(str(root))]
    return [path for path in found if not any(path != other and path.startswith(other + os.sep) for other in found)]


def _read(report: Path) -> Dict[str, Any]:
    try:
        return json.loads(report.read_text())
    except (OSError, ValueError):  # it was killed
        return {"terms": [], "steps": 0, "backward_passes": 0, "unseen": []}
