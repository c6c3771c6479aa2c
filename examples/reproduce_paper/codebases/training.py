"""One row: a codebase's script trains in a copy of its checkout and draws its views, which are scored here."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, Optional, Sequence, Set

from examples.reproduce_paper.codebases.profile import Edit, Profile, fill
from legs_loss.errors import LegsError
from legs_loss.lab.report.html_pictures import read_picture
from legs_loss.lab.training.densify import Schedule
from legs_loss.lab.training.metrics import mean_scores, score
from legs_loss.spec import WeightSpec
from legs_loss.system.files import read_regular, write_whole

__all__ = ["Checkout", "check_copy", "copy_checkout", "gaussians_in", "train_and_score"]

LAUNCH = Path(__file__).resolve().parents[1] / "launch.py"
# Files that are not copied; and what a folder of installed packages has in it, which is not either.
UNNEEDED = (".git", "__pycache__", "node_modules", "output", "outputs")
INSTALLED = ("pyvenv.cfg", "conda-meta")
_LARGEST = 256 << 20  # bytes of a step's report


@dataclass(frozen=True)
class Checkout:
    """A copy of a codebase, and how all its trainings are run.

    Attributes:
        root: the copy.
        profile: its commands.
        scene: the scene's folder.
        images, resolution, iterations, gaussians: as the user gave them; None leaves the codebase's own.
        extra: words for every training.
        cpu: without a GPU, by `legs run --cpu --ssim`: every arm, the baseline too, has its SSIM from `legs_loss.ssim`.
    """

    root: Path
    profile: Profile
    scene: Path
    images: Optional[str] = None
    resolution: Optional[int] = None
    iterations: Optional[int] = None
    gaussians: Optional[int] = None
    extra: Sequence[str] = ()
    cpu: bool = False

    def commands(self, output: Path, factor: float) -> List[List[str]]:
        """Return the commands that train into ``output``, with the thresholds times ``factor``."""
        places: Dict[str, Any] = dict(scene=self.scene, output=output, name=_run_name(output))
        commands = [fill(words, places) for words in self.profile.train]
        schedule = {} if self.iterations is None else Schedule.of_run(self.iterations)._asdict()
        for option, value, more in (
            ("images", self.images, {}),
            ("resolution", self.resolution, {}),
            ("iterations", self.iterations, schedule),
            ("gaussians", self.gaussians, {}),
        ):
            words = getattr(self.profile, {"iterations": "shorter", "gaussians": "number"}.get(option, option))
            named = re.findall(rf"(\S+)[ =]\{{{option}\}}", words)[:1]
            there = [word for word in self.extra if re.split("[ =]", word)[0] in (*named, f"--{option}")]
            if there:
                raise LegsError(f"--extra has {there[0]}: give --{option} outside of it, so that the comparison knows")
            if value is not None:
                if not words and not (option == "resolution" and self.profile.scales):
                    raise LegsError(f"the profile {self.profile.name} has no option for {option}")
                commands[-1] += fill(words, {option: value, **more})
        commands[-1] += self.extra
        if factor != 1.0:
            for threshold, usual in zip(self.profile.threshold, self.thresholds()):  # the last word counts
                commands[-1] += fill(threshold.words, {"value": f"{factor * usual:.6g}"})
        return commands

    def drawing(self, output: Path, results: Path) -> List[List[str]]:
        """Return the commands that draw the views of a run."""
        places = {"output": output, "results": results, "name": _run_name(output)}
        return [fill(words, places) for words in self.profile.render]

    def check(self) -> None:
        """Raise a LegsError, before anything is trained, for what no run of these settings and this profile can do."""
        if self.profile.scales and self.resolution not in (None, 1, 2, 4, 8):
            raise LegsError(f"{self.profile.name} divides the photographs' size: give -r 1, 2, 4 or 8")
        output = self.root / "ARM" / "seed-0" / "output"
        self.commands(output, 0.5)
        self.drawing(output, output)
        for pattern in (*self.profile.renders.values(), *self.profile.truths.values(), self.profile.cloud):
            _found(output, pattern)
        if self.profile.results:
            _found(output, self._pattern(output))

    def thresholds(self) -> List[float]:
        """Return the thresholds that the control of the number scales: those in ``extra``, else the codebase's own."""
        return [threshold.given(self.extra) or threshold.value for threshold in self.profile.threshold]

    def results(self, output: Path) -> Path:
        """Return the folder of a run: the newest, if its codebase adds the time to its name."""
        return _only(self.root, self._pattern(output)) if self.profile.results else output

    def _pattern(self, output: Path) -> str:
        return fill(shlex.quote(self.profile.results), {"name": _run_name(output)})[0]


def copy_checkout(root: Path, copy: Path, edits: Sequence[Edit] = ()) -> None:
    """Copy a codebase to where its trainings may write, and edit texts of the copy.

    The comparison's own folder, which may lie in the checkout, and environments of Python are left out.

    Raises:
        LegsError: it is no folder, or is patched already: its baseline would be too; or a text to edit is not there, or
            not in the copy; or a file cannot be read.
    """
    if not root.is_dir():
        raise LegsError(f"there is no folder {root}: give a checkout of the codebase")
    patched = next((path for path in _scripts(root, copy) if _is_patched(path)), None)
    if patched is not None or (root / ".legs-patch.json").exists():
        raise LegsError(f"{patched or root} is patched already, so there is no baseline: legs-patch {root} --undo")
    edited = _edited(root, edits)
    part = copy.with_name(copy.name + ".part")
    shutil.rmtree(str(part), ignore_errors=True)
    try:
        shutil.copytree(
            str(root), str(part), symlinks=True, ignore=lambda folder, names: _unneeded(folder, names, copy)
        )
    except shutil.Error as error:
        source, _, why = error.args[0][0]
        raise LegsError(f"{source} cannot be copied: {why}") from None
    (part / ".git").mkdir()  # it ends here: what lies above is not looked at
    for file, content in edited.items():
        if part.resolve() not in (part / file).resolve().parents:
            shutil.rmtree(str(part))
            raise LegsError(f"{root / file}: a link leads the edit of the profile out of the copy: put the file there")
        (part / file).write_bytes(content)
    os.replace(str(part), str(copy))


def check_copy(root: Path, copy: Path, edits: Sequence[Edit] = ()) -> None:
    """Check that a copy, in which a comparison goes on, is of this checkout as it is now.

    Raises:
        LegsError: it is of another one.
    """
    if not root.is_dir():
        raise LegsError(f"there is no folder {root}: give the checkout, or its copy, {copy}")
    edited = {os.path.normpath(edit.file) for edit in edits}
    for path in _scripts(root, copy):
        name = str(path.relative_to(root))
        there = copy / name
        if path.is_file() and name not in edited and not (there.is_file() and there.read_bytes() == path.read_bytes()):
            raise LegsError(
                f"{path}: the comparison was started with another checkout, in which this file differs: choose another "
                f"folder (--out), or go on with the copy of it: --upstream {copy}"
            )


def _edited(root: Path, edits: Sequence[Edit]) -> Dict[str, bytes]:
    """Return the edited files' contents, by the files' names."""
    contents: Dict[str, bytes] = {}
    for edit in edits:
        file = root / edit.file
        content = contents.get(edit.file) or (file.read_bytes() if file.is_file() else b"")
        if edit.old.encode() not in content:
            raise LegsError(f"{file}: the profile edits {edit.old!r}, which is not there")
        contents[edit.file] = content.replace(edit.old.encode(), edit.new.encode())
    return contents


def _is_patched(path: Path) -> bool:
    return path.is_file() and b"import legs_loss" in path.read_bytes()


def _scripts(root: Path, copy: Path) -> Iterator[Path]:
    """Yield the Python files of what is copied of a checkout, links too."""
    for folder, folders, names in os.walk(str(root)):
        unneeded = _unneeded(folder, folders, copy)
        folders[:] = sorted(name for name in folders if name not in unneeded)
        yield from (Path(folder, name) for name in sorted(names) if name.endswith(".py"))


def _unneeded(folder: str, names: List[str], copy: Path) -> Set[str]:
    """Return what is not copied of a folder: tool output, installed packages, pipes, sockets, devices, the copy."""
    paths = {name: os.path.join(folder, name) for name in names}
    kinds = {name: stat.S_IFMT(os.lstat(path).st_mode) for name, path in paths.items()}
    odd = {name for name, kind in kinds.items() if kind not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK)}
    own = {os.path.realpath(str(path)) for path in (copy.parent, copy, copy.with_name(copy.name + ".part"))}
    left = {name for name, path in paths.items() if os.path.realpath(path) in own}
    left |= {name for name, path in paths.items() if any(os.path.exists(os.path.join(path, one)) for one in INSTALLED)}
    return odd | left | set(shutil.ignore_patterns(*UNNEEDED)(folder, names))


def train_and_score(checkout: Checkout, spec: WeightSpec, seed: int, folder: Path, factor: float) -> Dict[str, Any]:
    """Train, draw and score one row; return its metrics. A repeated call skips finished steps.

    Raises:
        LegsError: a command failed, or the baseline was weighted, or an arm was not.
    """
    folder.mkdir(parents=True, exist_ok=True)
    output = folder.resolve() / "output"
    commands = checkout.commands(output, factor)
    if not (folder / "train.json").is_file():
        shutil.rmtree(str(output), ignore_errors=True)  # what a killed training left
    report = _once(checkout, "train", commands, spec, seed, folder)
    if spec.unweighted and report["weighted"]:
        raise LegsError(f"{folder}: the baseline was weighted in {report['weighted']} calls: it is not a baseline")
    if spec.unweighted and not report["plain"]:
        raise LegsError(f"{folder}: no call of its loss was counted: `legs-patch --check {checkout.root}` says why")
    if not spec.unweighted and not report["weighted"]:
        raise LegsError(f"{folder}: nothing was weighted: `legs-patch --check {checkout.root}` says why")
    results = checkout.results(output)
    _once(checkout, "render", checkout.drawing(output, results), WeightSpec(beta=0.0), 0, folder)
    renders, truths = (
        {split: _only(results, patterns[split]) for split in ("train", "test")}
        for patterns in (checkout.profile.renders, checkout.profile.truths)
    )
    views = {split: _scores(renders[split], truths[split], split) for split in ("train", "test")}
    return {
        "train": mean_scores(list(views["train"].values())),
        "test": mean_scores(list(views["test"].values())) if views["test"] else None,
        "gaussians": gaussians_in(_only(results, checkout.profile.cloud)),
        "densify_grad_threshold": [factor * value for value in checkout.thresholds()],
        "iterations": checkout.iterations or checkout.profile.iterations,
        "weighted_calls": report["weighted"],
        "plain_calls": report["plain"],
        "seconds": report["seconds"],
        "processor_seconds": report["processor_seconds"],
        "growth": [],
        "history": [],
        "views": views,
        "pictures": [str((renders["test"] / name).resolve()) for name in views["test"]],
    }


def gaussians_in(cloud: Path) -> int:
    """Return the number of Gaussians in the header of a .ply."""
    with open(str(cloud), "rb") as file:
        for _, line in zip(range(200), file):
            if line.startswith(b"element vertex"):
                return int(line.split()[-1])
    raise LegsError(f"{cloud}: there is no number of Gaussians in its header")


def _run_name(output: Path) -> str:
    """Return the name of a run, for codebases with one folder for all runs: ARM-seed-N."""
    return "-".join(output.parts[-3:-1])


def _once(
    checkout: Checkout, step: str, commands: Sequence[Sequence[str]], spec: WeightSpec, seed: int, folder: Path
) -> Dict[str, Any]:
    """Run a step's commands unless its report exists, and return the report of the last command."""
    done = folder / f"{step}.json"
    if done.is_file():
        try:
            kept = json.loads(read_regular(done, _LARGEST).decode("utf-8"))
            known = kept.get("commands")
        except (OSError, ValueError, AttributeError, RecursionError):
            raise LegsError(f"{done}: this file is damaged: delete it and run the comparison again") from None
        if known != [list(map(str, words)) for words in commands]:
            raise LegsError(f"{done}: this was made by other commands: choose another folder (--out)")
        return kept
    part = folder / f"{step}.json.part"
    log = folder / f"{step}.log"
    for words in commands:
        part.unlink() if part.exists() else None
        prefix = [sys.executable, str(LAUNCH), str(part.resolve()), str(seed)]
        words = [*prefix, *(["--cpu", "--ssim"] if checkout.cpu else []), *words]
        with open(str(log), "ab") as output:
            code = subprocess.run(
                words, cwd=str(checkout.root), env=_environment(spec, seed), stdout=output, stderr=output,
                stdin=subprocess.DEVNULL,
            ).returncode  # fmt: skip
        if code != 0 or not part.is_file():
            raise LegsError(f"the codebase's script ended with exit code {code}; its log: {log}", _tail(log))
    report = dict(json.loads(part.read_text(encoding="utf-8")), commands=[list(map(str, words)) for words in commands])
    write_whole(done, (json.dumps(report, indent=1) + "\n").encode())
    part.unlink()
    return report


def _environment(spec: WeightSpec, seed: int) -> Dict[str, str]:
    """Return the environment of a script whose loss has this spec, independent of any legs.toml."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("LEGS_")}
    environment.update({f"LEGS_{field.name.upper()}": str(getattr(spec, field.name)) for field in fields(spec)})
    environment["PYTHONHASHSEED"] = str(seed)
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    return environment


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").replace("\r", "\n").strip().splitlines()[-12:]
    return "\n".join(f"    {line}" for line in lines)


def _only(folder: Path, pattern: str) -> Path:
    """Return the last path that a pattern finds, by the numbers in it: iteration_30000 after iteration_7000."""
    found = _found(folder, pattern)
    if not found:
        raise LegsError(f"the codebase's script left nothing in {folder / pattern}")
    return max(
        found, key=lambda path: [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", str(path))]
    )


def _found(folder: Path, pattern: str) -> List[Path]:
    try:
        if ".." not in Path(pattern).parts:
            return list(folder.glob(pattern))
    except (ValueError, NotImplementedError, IndexError):
        pass
    raise LegsError(f"{pattern!r} is no pattern of files in the run's folder: see pathlib.Path.glob")


def _scores(renders: Path, truths: Path, split: str) -> Dict[str, Mapping[str, float]]:
    names = sorted(path.name for path in renders.glob("*.png"))
    if names != sorted(path.name for path in truths.glob("*.png")):
        raise LegsError(f"{renders} and {truths} do not hold the same views")
    return {name: score(read_picture(renders / name), read_picture(truths / name), split) for name in names}
