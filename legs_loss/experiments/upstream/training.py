"""One row: a codebase's script trains in a copy of its checkout and draws its views, which are scored here."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Sequence, Set

import numpy as np
import torch

from legs_loss.errors import LegsError
from legs_loss.experiments.upstream.profile import Edit, Profile, fill
from legs_loss.reference.training.densify import Schedule
from legs_loss.reference.training.metrics import mean_scores, score
from legs_loss.scenes import open_image
from legs_loss.spec import WeightSpec
from legs_loss.system import read_regular

__all__ = ["Checkout", "copy_checkout", "gaussians_in", "read_picture", "train_and_score"]

# Files that are not copied.
UNNEEDED = (".git", "__pycache__", "node_modules", "output", "outputs")
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
        schedule = {} if self.iterations is None else Schedule.of(self.iterations)._asdict()
        for option, value, more in (
            ("images", self.images, {}),
            ("resolution", self.resolution, {}),
            ("iterations", self.iterations, schedule),
            ("gaussians", self.gaussians, {}),
        ):
            words = getattr(self.profile, {"iterations": "shorter", "gaussians": "number"}.get(option, option))
            if value is not None:
                if not words:
                    raise LegsError(f"the profile {self.profile.name} has no option for {option}")
                commands[-1] += fill(words, {option: value, **more})
        commands[-1] += self.extra
        if factor != 1.0:
            for threshold, usual in zip(self.profile.threshold, self.thresholds()):  # the last word counts
                commands[-1] += fill(threshold.words, {"value": f"{factor * usual:.6g}"})
        return commands

    def thresholds(self) -> List[float]:
        """Return the thresholds that the control of the number scales: those in ``extra``, else the codebase's own."""
        return [threshold.given(self.extra) or threshold.value for threshold in self.profile.threshold]

    def results(self, output: Path) -> Path:
        """Return the folder of a run: the newest, if its codebase adds the time to its name."""
        if not self.profile.results:
            return output
        pattern = self.profile.results.format(name=_run_name(output))
        found = sorted(self.root.glob(pattern))
        if not found:
            raise LegsError(f"the training left nothing in {self.root / pattern}")
        return found[-1]


def copy_checkout(root: Path, copy: Path, edits: Sequence[Edit] = ()) -> None:
    """Copy a codebase to where its trainings may write, and edit texts of the copy.

    Raises:
        LegsError: it is no folder, or is patched already: its baseline would be too; or a text to edit is not there, or
            not in the copy.
    """
    if not root.is_dir():
        raise LegsError(f"there is no folder {root}: give a checkout of the codebase")
    patched = next((path for path in sorted(root.rglob("*.py")) if _is_patched(path)), None)
    if patched is not None or (root / ".legs-patch.json").exists():
        raise LegsError(f"{patched or root} is patched already, so there is no baseline: legs-patch {root} --undo")
    edited = _edited(root, edits)
    part = copy.with_name(copy.name + ".part")
    shutil.rmtree(str(part), ignore_errors=True)
    shutil.copytree(str(root), str(part), symlinks=True, ignore=_unneeded)
    (part / ".git").mkdir()  # it ends here: what lies above is not looked at
    for file, content in edited.items():
        if part.resolve() not in (part / file).resolve().parents:
            shutil.rmtree(str(part))
            raise LegsError(f"{root / file}: a link leads the edit of the profile out of the copy: put the file there")
        (part / file).write_bytes(content)
    os.replace(str(part), str(copy))


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


def _unneeded(folder: str, names: List[str]) -> Set[str]:
    """Return what is not copied of a folder: tool output, and pipes, sockets and devices."""
    kinds = {name: stat.S_IFMT(os.lstat(os.path.join(folder, name)).st_mode) for name in names}
    odd = {name for name, kind in kinds.items() if kind not in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFLNK)}
    return odd | set(shutil.ignore_patterns(*UNNEEDED)(folder, names))


def train_and_score(checkout: Checkout, spec: WeightSpec, seed: int, folder: Path, factor: float) -> Dict[str, Any]:
    """Train, draw and score one row; return its metrics. A repeated call skips finished steps.

    Raises:
        LegsError: a command failed, or the baseline was weighted, or an arm was not.
    """
    folder.mkdir(parents=True, exist_ok=True)
    output = folder.resolve() / "output"
    commands = checkout.commands(output, factor)
    report = _once(checkout, "train", commands, spec, seed, folder)
    if spec.unweighted and report["weighted"]:
        raise LegsError(f"{folder}: the baseline was weighted in {report['weighted']} calls: it is not a baseline")
    if not spec.unweighted and not report["weighted"]:
        raise LegsError(f"{folder}: nothing was weighted: `legs-patch --check {checkout.root}` says why")
    results = checkout.results(output)
    places = {"output": output, "results": results, "name": _run_name(output)}
    draw = [fill(words, places) for words in checkout.profile.render]
    _once(checkout, "render", draw, WeightSpec(beta=0.0), 0, folder)
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
        prefix = [sys.executable, "-m", "legs_loss.experiments.upstream.launch", str(part.resolve()), str(seed)]
        words = [*prefix, *(["--cpu", "--ssim"] if checkout.cpu else []), *words]
        with open(str(log), "ab") as said:
            code = subprocess.run(
                words, cwd=str(checkout.root), env=_environment(spec, seed), stdout=said, stderr=said,
                stdin=subprocess.DEVNULL,
            ).returncode  # fmt: skip
        if code != 0 or not part.is_file():
            raise LegsError(f"the codebase's script ended with exit code {code}; its log: {log}", _tail(log))
    report = dict(json.loads(part.read_text(encoding="utf-8")), commands=[list(map(str, words)) for words in commands])
    part.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    os.replace(str(part), str(done))
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
    found = sorted(folder.glob(pattern))
    if not found:
        raise LegsError(f"the codebase's script left nothing in {folder / pattern}")
    return found[-1]


def _scores(renders: Path, truths: Path, split: str) -> Dict[str, Mapping[str, float]]:
    names = sorted(path.name for path in renders.glob("*.png"))
    if names != sorted(path.name for path in truths.glob("*.png")):
        raise LegsError(f"{renders} and {truths} do not hold the same views")
    return {name: score(read_picture(renders / name), read_picture(truths / name), split) for name in names}


def read_picture(path: Path) -> torch.Tensor:
    """Return a picture that a codebase wrote, [3, H, W] in [0, 1]."""
    with open_image(path) as image:
        pixels = np.asarray(image.convert("RGB"), np.float32) / 255.0
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()
