"""Verify a patch on the CPU: train the patched and the unpatched script, and compare the runs.

Three runs of copies of the checkout, on the embedded scene, from the same seed: unpatched, patched, and patched with
LEGS_OFF=1; of a patch with --ssim also a fourth, patched with beta 0, where nothing but the SSIM differs. Each is a
process of its own, see :mod:`legs_adapters.watched`.
"""

from __future__ import annotations

import json
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
from legs_adapters.undo import undo
from legs_loss import LegsError

__all__ = ["Run", "Verdict", "check_verifiable", "verify"]

VIEWS, WIDTH, HEIGHT, POINTS = 12, 96, 64, 800  # of the embedded scene
SECONDS = 1800  # that a run may take
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
        weighted, weighted_without_gradient, plain: calls of legs_loss.l1_loss.
        stored, computed, remembered: where weight maps came from.
        error: the last lines of its stderr.
        ssims: calls of legs_loss.ssim in training.
    """

    code: int
    losses: Sequence[str] = ()
    seconds: Sequence[float] = ()
    weighted: int = 0
    weighted_without_gradient: int = 0
    plain: int = 0
    stored: int = 0
    computed: int = 0
    remembered: int = 0
    error: str = ""
    ssims: int = 0


class Verdict(NamedTuple):
    """The runs, and each claim with whether it holds."""

    runs: Dict[str, Run]
    claims: Dict[str, bool]

    def text(self) -> str:
        """Return the report."""
        rows = []
        for name, run in self.runs.items():
            step = f"{1000 * statistics.median(run.seconds):.0f} ms a step" if run.seconds else "no step"
            rows.append((name, f"{len(run.losses)} steps, {step}" + (f", exit code {run.code}" if run.code else "")))
        if "patched" in self.runs:
            patched, unpatched = self.runs["patched"], self.runs["unpatched"]
            if patched.seconds and unpatched.seconds:
                ratio = statistics.median(patched.seconds) / statistics.median(unpatched.seconds)
                rows.append(("step", f"patched takes {ratio:.2f} times the unpatched one's time (medians)"))
            without = f"{patched.weighted_without_gradient} in no-grad code"
            rows.append(("l1_loss", f"{patched.weighted} calls weighted in training, {without}; {patched.plain} plain"))
            rows += [("ssim", f"{patched.ssims} calls in training")] if patched.ssims else []
            computed = f"{patched.computed} computed; {patched.remembered} reused"
            rows.append(("maps", f"{patched.stored} from the store, {computed}"))
        rows += [("holds" if held else "FAILS", claim) for claim, held in self.claims.items()]
        lines = [f"{name:<10} {what}" for name, what in rows]
        for name, run in self.runs.items():
            if run.code != 0 and run.error:
                lines += [f"{name} ended with:", *(f"    {line}" for line in run.error.splitlines())]
        return "\n".join(lines) + "\n"


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
    from legs_loss.precompute import precompute
    from legs_loss.reference.embedded import write_embedded_scene
    from legs_loss.scenes import read_scene

    root = check_root(folder)
    runs: Dict[str, Run] = {}
    with tempfile.TemporaryDirectory(prefix="legs-verify-") as work:
        scene = write_embedded_scene(
            Path(work) / "scene", views=VIEWS, width=WIDTH, height=HEIGHT, points=POINTS, samples=1
        )
        precompute(read_scene(scene), scene / "legs_weights")
        patched, unpatched = (Path(work) / name / root.name for name in ("patched", "unpatched"))
        with locked(root, f"legs-patch --verify {folder}"):
            for copy in (patched, unpatched):
                shutil.copytree(str(root), str(copy), symlinks=True, ignore=_unneeded)
            if not (root / JOURNAL).is_file():  # undone by another one, before this one had the lock
                raise LegsError(f"{root} is not patched any more: nothing to verify")
        undo(unpatched, force=True)
        for name, copy, settings in (
            ("unpatched", unpatched, {}),
            ("patched", patched, {}),
            ("LEGS_OFF", patched, {"LEGS_OFF": "1"}),
            ("beta 0", patched, {"LEGS_BETA": "0"}),
        ):
            if name == "beta 0" and not runs["patched"].ssims:
                continue
            given = _arguments(copy / script, arguments, iterations, scene=scene, output=Path(work) / f"output-{name}")
            runs[name] = _run(copy, [script, *given], iterations, Path(work) / f"{name}.json", settings)
            if not runs["unpatched"].losses:
                return Verdict(runs, {"the unpatched script trained": False})
    return Verdict(runs, _claims(runs))


def _claims(runs: Dict[str, Run]) -> Dict[str, bool]:
    unpatched, patched, off = runs["unpatched"], runs["patched"], runs["LEGS_OFF"]
    steps = len(unpatched.losses)
    claims = {
        "all three trained": all(run.code == 0 and run.losses for run in runs.values()),
        "as many steps each": steps == len(patched.losses) == len(off.losses),
        "with LEGS_OFF=1 every loss is the unpatched one, bit for bit": steps > 0 and off.losses == unpatched.losses,
        "with LEGS every loss is another": steps > 0
        and all(first != second for first, second in zip(unpatched.losses, patched.losses)),
        "every step was weighted": patched.weighted >= len(patched.losses) > 0,
        "nothing was weighted in no-grad code": patched.weighted_without_gradient == 0,
        "nothing was weighted with LEGS_OFF=1": off.weighted == 0,
    }
    if "beta 0" in runs:
        equal = _are_close(unpatched.losses, runs["beta 0"].losses)
        claims["with beta 0 every loss is the unpatched one, up to the rounding of the SSIM"] = equal
    return claims


def _are_close(losses: Sequence[str], others: Sequence[str]) -> bool:
    """Return whether the losses of two trainings agree: the first to rounding, which the later steps carry on."""
    pairs = [(float.fromhex(one), float.fromhex(other)) for one, other in zip(losses, others)]
    bounds = [FIRST_STEP, *[LATER_STEPS] * len(pairs)]
    return 0 < len(pairs) == len(losses) == len(others) and all(
        abs(one - other) <= bound * abs(one) for (one, other), bound in zip(pairs, bounds)
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
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    if given is None:
        source = "\n".join(_text(path) for path in (script, *script.parent.glob("arguments/*.py")))
        given = " ".join(words for word, words in ARGUMENTS if word in source)
    values = {"iterations": iterations, "port": port, **places}
    try:
        return [word.format(**values) for word in shlex.split(given)]
    except (KeyError, IndexError, ValueError) as error:
        raise LegsError(
            f"--arguments {given!r}: only {{scene}}, {{output}}, {{iterations}}, {{port}}: {error}"
        ) from None


def _unneeded(folder: str, names: List[str]) -> List[str]:
    """Return what is not copied: histories, caches, and anything large."""
    left = {".git", ".legs-patch.lock", "__pycache__", "node_modules", "output", "outputs"} & set(names)
    for name in names:
        path = os.path.join(folder, name)
        special = os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)  # pipes, sockets
        if special or (os.path.isfile(path) and os.path.getsize(path) > 64 << 20):
            left.add(name)
    return sorted(left)


def _run(root: Path, words: Sequence[str], iterations: int, report: Path, settings: Dict[str, str]) -> Run:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(CUDA_VISIBLE_DEVICES="", PYTHONHASHSEED="0", **settings)
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    command = [sys.executable, "-m", "legs_adapters.watched", str(report), str(iterations), str(root), *words]
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
