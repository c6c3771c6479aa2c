"""Verify a patch on the CPU: train the patched and the unpatched script, and compare the runs.

Three runs of copies of the checkout, on the embedded scene, from the same seed: unpatched, patched, and patched with
LEGS_OFF=1; of a patch with --ssim also a fourth, patched with beta 0, where nothing but the SSIM differs. Each is a
process of its own, see :mod:`legs_adapters.trace.child`.
"""

from __future__ import annotations

import json
import math
import os
import shlex
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Dict, List, NamedTuple, Optional, Sequence

from legs_adapters.checkout.replace import locked
from legs_adapters.code.sources import check_root
from legs_adapters.journal import JOURNAL
from legs_adapters.plan import plan
from legs_adapters.shims.packages import check_imports
from legs_adapters.trace.running import CHILD, child_environment
from legs_adapters.undo import undo
from legs_loss import LegsError

__all__ = ["Run", "Verdict", "check_verifiable", "embedded_arguments", "verify"]

SCENE = {"views": 12, "width": 96, "height": 64, "points": 800, "samples": 1}  # the embedded one
SECONDS = 1800  # that a run may take
NOT_COPIED = (".git", ".legs-patch.lock", "__pycache__", "node_modules", "output", "outputs")
MAX_COPIED = 64 << 20  # bytes of a file
FIRST_STEP, LATER_STEPS = 1e-5, 1e-3  # relative differences of losses that rounding explains
# The arguments of a script like Inria's, where its source has these words. (Inria's options are named after attributes,
# except those that train.py adds itself.)
ARGUMENTS = (
    ("source_path", "-s {scene}"),
    ("model_path", "-m {output}"),
    ("iterations", "--iterations {iterations}"),
    ("--test_iterations", "--test_iterations {iterations}"),
    ("--port", "--port {port}"),
)


class Run(NamedTuple):
    """The record of one run.

    Attributes:
        code: its exit code.
        losses: the value of every loss that was trained on, as float.hex has it.
        seconds: from each step to the next.
        weighted, plain: calls of legs_loss.l1_loss.
        stored, computed, remembered: where weight maps came from.
        error: the last lines of its stderr.
    """

    code: int
    losses: Sequence[str] = ()
    seconds: Sequence[float] = ()
    weighted: int = 0
    plain: int = 0
    stored: int = 0
    computed: int = 0
    remembered: int = 0
    error: str = ""

    @property
    def step(self) -> Optional[float]:
        """The seconds that a step takes, by the median; None without two steps."""
        return statistics.median(self.seconds) if self.seconds else None


class Verdict(NamedTuple):
    """The runs, and each claim with whether it holds."""

    runs: Dict[str, Run]
    claims: Dict[str, bool]

    def text(self) -> str:
        """Return the report."""
        rows = []
        for name, run in self.runs.items():
            step = "no step" if run.step is None else f"{1000 * run.step:.0f} ms a step"
            rows.append((name, f"{len(run.losses)} steps, {step}" + (f", exit code {run.code}" if run.code else "")))
        unpatched, patched = self.runs["unpatched"], self.runs.get("patched")
        if patched is not None:
            if patched.step and unpatched.step:
                ratio = patched.step / unpatched.step
                rows.append(("step", f"patched takes {ratio:.2f} times the unpatched one's time (medians)"))
            rows.append(("l1_loss", f"{patched.weighted} calls weighted, {patched.plain} plain"))
            computed = f"{patched.computed} computed; {patched.remembered} reused"
            rows.append(("maps", f"{patched.stored} from the store, {computed}"))
        rows += [("holds" if held else "FAILS", claim) for claim, held in self.claims.items()]
        rows += [(name, line) for name, run in self.runs.items() if run.code for line in run.error.splitlines()]
        return "".join(f"{name:<10} {what}\n" for name, what in rows)


def check_verifiable(folder: str | os.PathLike[str], script: Optional[str], arguments: Optional[str]) -> str:
    """Return the training script, after checking before anything is patched that it can be run.

    Args:
        folder: the checkout.
        script: the training script in it; None: the file of its one weighted term, or its train.py.
        arguments: as for :func:`verify`.

    Raises:
        LegsError: it is ambiguous or not there, imports what is not installed, or its arguments name what is unknown.
    """
    root = check_root(folder)
    script = _script(root) if script is None else script
    if not (root / script).is_file():
        raise LegsError(f"there is no {script} in {root}")
    check_imports(root, script)
    _arguments(root / script, arguments, 1, scene=root, output=root)
    return script


def verify(folder: str | os.PathLike[str], script: str, arguments: Optional[str], iterations: int) -> Verdict:
    """Train a patched checkout and its unpatched self on the CPU, and compare.

    Args:
        folder: the patched checkout; nothing is written there.
        script: the training script in it.
        arguments: the script's arguments, with {scene}, {output}, {iterations} and {port} filled in; None: those of
            Inria's train.py that its source knows.
        iterations: how many steps are compared; the script is ended then.

    Raises:
        LegsError: the folder is not patched any more.
    """
    from legs_loss.lab.embedded import write_embedded_scene
    from legs_loss.precompute import precompute
    from legs_loss.scenes import read_scene

    root = check_root(folder)
    runs: Dict[str, Run] = {}
    with tempfile.TemporaryDirectory(prefix="legs-verify-") as work:
        scene = write_embedded_scene(Path(work) / "scene", **SCENE)
        precompute(read_scene(scene), scene / "legs_weights")
        patched, unpatched = (Path(work) / name / root.name for name in ("patched", "unpatched"))
        with locked(root, f"legs-patch --verify {folder}") as stop:
            for copy in (patched, unpatched):
                shutil.copytree(str(root), str(copy), symlinks=True, ignore=lambda *at: stop() or _unneeded(*at))
        if not (patched / JOURNAL).is_file():  # undone by another one, before this one had the lock
            raise LegsError(f"{root} is not patched any more: nothing to verify")
        undo(unpatched, force=True)
        variables: Dict[str, Dict[str, str]] = {"unpatched": {}, "patched": {}, "LEGS_OFF": {"LEGS_OFF": "1"}}
        if b"legs_loss.ssim" in (patched / JOURNAL).read_bytes():
            variables["beta 0"] = {"LEGS_BETA": "0"}
        for name, settings in variables.items():
            copy = unpatched if name == "unpatched" else patched
            given = _arguments(copy / script, arguments, iterations, scene=scene, output=Path(work) / f"output-{name}")
            runs[name] = _run(copy, [script, *given], iterations, Path(work) / f"{name}.json", settings)
            if not runs["unpatched"].losses:
                return Verdict(runs, {"the unpatched script trained": False})
    return Verdict(runs, _claims(runs))


def _claims(runs: Dict[str, Run]) -> Dict[str, bool]:
    losses = {name: list(run.losses) for name, run in runs.items()}
    unpatched, patched, off = losses["unpatched"], losses["patched"], losses["LEGS_OFF"]
    claims = {
        "all three trained": all(run.code == 0 and run.losses for run in runs.values()),
        "as many steps each": len(unpatched) == len(patched) == len(off),
        "with LEGS_OFF=1 every loss is the unpatched one, bit for bit": off == unpatched,
        "with LEGS every loss is another": all(one != other for one, other in zip(unpatched, patched)),
        "every step was weighted": runs["patched"].weighted >= len(patched) > 0,
        "nothing was weighted with LEGS_OFF=1": runs["LEGS_OFF"].weighted == 0,
    }
    if "beta 0" in runs:
        equal = _are_close(unpatched, losses["beta 0"])
        claims["with beta 0 every loss is the unpatched one, up to the rounding of the SSIM"] = equal
    return claims


def _are_close(losses: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether the losses of two trainings agree: the first to rounding, which the later steps carry on."""
    bounds = [FIRST_STEP, *[LATER_STEPS] * len(losses)]
    return len(losses) == len(others) and all(
        math.isclose(float.fromhex(one), float.fromhex(other), rel_tol=bound)
        for one, other, bound in zip(losses, others, bounds)
    )


def _script(root: Path) -> str:
    found = plan(root).findings
    files = sorted({site.path for site in found.sites} | {site.path for site in found.patched})
    trains = [name for name in files if "__main__" in _text(root / name)]
    if len(trains) == 1:
        return trains[0]
    if "train.py" in trains or (not trains and (root / "train.py").is_file()):
        return "train.py"
    raise LegsError(f"cannot tell which script trains: use --script; weighted files: {', '.join(files) or 'none'}")


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""


def _arguments(script: Path, given: Optional[str], iterations: int, **places: Path) -> List[str]:
    if given is None:
        given = _words_of(script)
    values = {"iterations": iterations, "port": _free_port(), **places}
    try:
        return [word.format(**values) for word in shlex.split(given)]
    except (KeyError, IndexError, ValueError) as error:
        raise LegsError(
            f"--arguments {given!r}: only {{scene}}, {{output}}, {{iterations}}, {{port}}: {error}"
        ) from None


def embedded_arguments(script: Path, given: Sequence[str], work: Path, iterations: int) -> List[str]:
    """Write the embedded scene to a folder, and return the arguments that name it, of those that are not given."""
    from legs_loss.lab.embedded import write_embedded_scene

    words = shlex.split(_words_of(script))
    pairs = [pair for pair in zip(words[::2], words[1::2]) if pair[0] not in given]
    places = {"scene": write_embedded_scene(work / "scene", **SCENE), "output": work / "output"}
    return _arguments(script, " ".join(f"{name} {value}" for name, value in pairs), iterations, **places)


def _words_of(script: Path) -> str:
    source = "\n".join(_text(path) for path in (script, *script.parent.glob("arguments/*.py")))
    return " ".join(words for word, words in ARGUMENTS if word in source)


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _unneeded(folder: str, names: List[str]) -> List[str]:
    """Return what is not copied: histories, caches, pipes and sockets, and anything large."""
    paths = {name: os.path.join(folder, name) for name in names if name not in NOT_COPIED}
    files = {name for name, path in paths.items() if os.path.isfile(path) and os.path.getsize(path) <= MAX_COPIED}
    return [name for name in names if name not in files and not os.path.isdir(paths.get(name, ""))]


def _run(root: Path, words: Sequence[str], iterations: int, report: Path, settings: Dict[str, str]) -> Run:
    spec = {"report": str(report), "root": str(root), "cpu": True, "iterations": iterations}
    command = [sys.executable, "-m", CHILD, json.dumps(spec), *words]
    environment = child_environment(True, PYTHONHASHSEED="0", **settings)
    with tempfile.TemporaryFile() as errors:
        try:
            code = subprocess.run(
                command, cwd=str(root), env=environment, stdout=subprocess.DEVNULL, stderr=errors,
                stdin=subprocess.DEVNULL, timeout=SECONDS,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            code = -1
        errors.seek(0)
        lines = errors.read().decode("utf-8", "replace").replace("\r", "\n").strip().splitlines()
    try:
        found = json.loads(report.read_text())
    except (OSError, ValueError):  # it was killed
        found = {}
    return Run(code=code, error="\n".join(lines[-12:]), **found)
