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

__all__ = ["ITERATIONS", "Run", "Verdict", "check_verifiable", "verify"]

ITERATIONS = 40
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
    losses: List[str]
    seconds: List[float]
    weighted: int
    weighted_without_gradient: int
    plain: int
    stored: int
    computed: int
    remembered: int
    error: str
    ssims: int = 0


class Verdict(NamedTuple):
    """The runs, and each claim with whether it holds."""

    runs: Dict[str, Run]
    claims: Dict[str, bool]

    @property
    def holds(self) -> bool:
        """Return whether all claims hold."""
        return all(self.claims.values())

    def text(self) -> str:
        """Return the report."""
        lines = []
        for name, run in self.runs.items():
            step = f"{1000 * statistics.median(run.seconds):.0f} ms a step" if run.seconds else "no step"
            ended = "" if run.code == 0 else f", exit code {run.code}"
            lines.append(f"{name:<10} {len(run.losses)} steps, {step}{ended}")
        if "patched" in self.runs:
            lines += self._patched_lines()
        lines += [f"{'holds' if held else 'FAILS':<10} {claim}" for claim, held in self.claims.items()]
        for name, run in self.runs.items():
            if run.code != 0 and run.error:
                lines += [f"{name} ended with:", *(f"    {line}" for line in run.error.splitlines())]
        return "\n".join(lines) + "\n"

    def _patched_lines(self) -> List[str]:
        patched, unpatched = self.runs["patched"], self.runs["unpatched"]
        lines = []
        if patched.seconds and unpatched.seconds:
            ratio = statistics.median(patched.seconds) / statistics.median(unpatched.seconds)
            lines.append(f"{'step':<10} patched takes {ratio:.2f} times the unpatched one's time (medians)")
        lines.append(
            f"{'l1_loss':<10} {patched.weighted} calls weighted in training, {patched.weighted_without_gradient} in "
            f"no-grad code; {patched.plain} plain"
        )
        if patched.ssims:
            lines.append(f"{'ssim':<10} {patched.ssims} calls in training")
        lines.append(
            f"{'maps':<10} {patched.stored} from the store, {patched.computed} computed; {patched.remembered} reused"
        )
        return lines


def check_verifiable(folder: str | os.PathLike[str], script: Optional[str], arguments: Optional[str]) -> None:
    """Check before anything is patched that the training script can be run; arguments as for :func:`verify`.

    Raises:
        LegsError: it is ambiguous or not there, imports what is not installed, or its arguments name what is unknown.
    """
    root = check_root(folder)
    script = _script(root, script)
    check_imports(root, script)
    _arguments(root / script, arguments, 1, scene=root, output=root)


def verify(
    folder: str | os.PathLike[str],
    script: Optional[str] = None,
    arguments: Optional[str] = None,
    iterations: int = ITERATIONS,
) -> Verdict:
    """Train a patched checkout and its unpatched self on the CPU, and compare.

    Args:
        folder: the patched checkout; nothing is written there.
        script: the training script in it; default: the file of its one weighted term, or its train.py.
        arguments: the script's arguments, with {scene}, {output}, {iterations} and {port} filled in; default: those of
            Inria's train.py that its source knows.
        iterations: how many steps are compared; the script is ended then.

    Raises:
        LegsError: the folder is not patched; or the training script is ambiguous.
    """
    from legs_loss.precompute import precompute
    from legs_loss.reference.embedded import write_embedded_scene
    from legs_loss.scenes import read_scene

    root = check_root(folder)
    if not (root / JOURNAL).is_file():
        raise LegsError(f"{root} is not patched: nothing to verify")
    script = _script(root, script)
    with tempfile.TemporaryDirectory(prefix="legs-verify-") as work:
        scene = write_embedded_scene(
            Path(work) / "scene", views=VIEWS, width=WIDTH, height=HEIGHT, points=POINTS, samples=1
        )
        precompute(read_scene(scene), scene / "legs_weights")
        patched, unpatched = (Path(work) / name / root.name for name in ("patched", "unpatched"))
        with locked(root, f"legs-patch --verify {folder}"):
            for copy in (patched, unpatched):
                shutil.copytree(str(root), str(copy), symlinks=True, ignore=_unneeded)
            if not (root / JOURNAL).is_file():  # taken back by another one, before this one had the lock
                raise LegsError(f"{root} is not patched any more: nothing to verify")
        undo(unpatched, force=True)
        runs: Dict[str, Run] = {}
        for name, (copy, settings) in {
            "unpatched": (unpatched, {}),
            "patched": (patched, {}),
            "LEGS_OFF": (patched, {"LEGS_OFF": "1"}),
            "beta 0": (patched, {"LEGS_BETA": "0"}),
        }.items():
            if name == "beta 0" and not runs["patched"].ssims:
                continue
            output = Path(work) / f"output-{name}"
            given = _arguments(copy / script, arguments, iterations, scene=scene, output=output)
            runs[name] = _run(copy, script, given, iterations, Path(work) / f"{name}.json", settings)
            if not runs["unpatched"].losses:
                return Verdict(runs, {"the unpatched script trained": False})
    return Verdict(runs, _claims(runs))


def _claims(runs: Dict[str, Run]) -> Dict[str, bool]:
    unpatched, patched, off = runs["unpatched"], runs["patched"], runs["LEGS_OFF"]
    steps = len(unpatched.losses)
    claims = {
        "all three trained": all(run.code == 0 and run.losses for run in runs.values()),
        "as many steps each": steps == len(patched.losses) == len(off.losses),
        "with LEGS_OFF=1 every loss is the unpatched one, to the last bit": steps > 0
        and off.losses == unpatched.losses,
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


def _script(root: Path, given: Optional[str]) -> str:
    if given is not None and not (root / given).is_file():
        raise LegsError(f"there is no {given} in {root}")
    if given is not None:
        return given
    found = plan(root).findings
    files = sorted({site.path for site in found.sites} | {site.path for site in found.patched})
    trains = [name for name in files if "__main__" in (root / name).read_text(encoding="utf-8", errors="replace")]
    if len(trains) == 1:
        return trains[0]
    if "train.py" in trains or (not trains and (root / "train.py").is_file()):
        return "train.py"
    raise LegsError(f"cannot tell which script trains: use --script; weighted files: {', '.join(files) or 'none'}")


def _arguments(script: Path, given: Optional[str], iterations: int, **places: Path) -> List[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    if given is None:
        source = "\n".join(
            path.read_text(encoding="utf-8", errors="replace")
            for path in (script, *script.parent.glob("arguments/*.py"))
            if path.is_file()
        )
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


def _run(
    root: Path, script: str, arguments: Sequence[str], iterations: int, report: Path, settings: Dict[str, str]
) -> Run:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update(
        {
            "CUDA_VISIBLE_DEVICES": "",
            "PYTHONHASHSEED": "0",
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
    )
    environment.update(settings)
    command = [
        sys.executable,
        "-m",
        "legs_adapters.watched",
        str(report),
        str(iterations),
        str(root),
        script,
        *arguments,
    ]
    with tempfile.TemporaryFile() as said:
        try:
            code = subprocess.run(
                command, cwd=str(root), env=environment, stdout=subprocess.DEVNULL, stderr=said,
                stdin=subprocess.DEVNULL, timeout=SECONDS,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            code = -1
        said.seek(0)
        error = said.read().decode("utf-8", "replace")
    try:
        found = json.loads(report.read_text())
    except (OSError, ValueError):
        counted = [field for field in Run._fields if field not in ("code", "error")]
        found = {field: [] if field in ("losses", "seconds") else 0 for field in counted}
    return Run(code=code, error="\n".join(error.replace("\r", "\n").strip().splitlines()[-12:]), **found)
