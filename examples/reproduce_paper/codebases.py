"""How each codebase is run: its own commands for training and rendering, and where it leaves what.

Each class gives, for a scene and an arm, the commands as lists of words; nothing is run here.
"""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Dict, List, NamedTuple, Optional

DATASETS: Dict[str, List[str]] = {
    "tanksandtemples": ["truck", "train"],
    "mipnerf360": ["bicycle", "flowers", "garden", "stump", "treehill", "room", "counter", "kitchen", "bonsai"],
}
INDOOR = ("room", "counter", "kitchen", "bonsai")


class Place(NamedTuple):
    """A scene: its folder, and the dataset and the name that say which official settings are its own."""

    path: Path
    dataset: str
    name: str


class Command(NamedTuple):
    """A command, where it is run, and what is added to the environment."""

    words: List[str]
    folder: Path
    environment: Dict[str, str]

    def __str__(self) -> str:
        settings = [f"{name}={shlex.quote(value)}" for name, value in self.environment.items()]
        words = [shlex.quote(word) for word in self.words]
        return f"cd {shlex.quote(str(self.folder))} && {' '.join([*settings, *words])}"


@dataclass(frozen=True)
class Codebase:
    """A checkout. ``cpu``: through `legs run --cpu`; ``extra``: words for every training."""

    root: Path
    cpu: bool
    extra: List[str]

    name = ""
    render_folders = {"train": "train/ours_*/renders", "test": "test/ours_*/renders"}
    truth_folders = {"train": "train/ours_*/gt", "test": "test/ours_*/gt"}
    cloud = "point_cloud/iteration_*/point_cloud.ply"

    def python(self, preset: Optional[str], words: List[str]) -> Command:
        """A Python script of the checkout: as it is with ``preset`` None, else with the LEGS loss."""
        environment = {"PYTHONHASHSEED": "0"}
        environment.update({"LEGS_OFF": "1"} if preset is None else {"LEGS_PRESET": preset})
        prefix = [sys.executable]
        if preset is not None or self.cpu:
            prefix += ["-m", "legs_loss", "run"] + (["--cpu"] if self.cpu else [])
        return Command([*prefix, *words], self.root, environment)

    def patched(self) -> Optional[Path]:
        """A file of the checkout that was patched on disk, None if there is none."""
        files = sorted(self.root.rglob("*.py"))
        return next((path for path in files if b"import legs_loss" in path.read_bytes()), None)

    def train(self, place: Place, out: Path, preset: Optional[str], factor: float) -> List[Command]:
        """Train; ``factor`` multiplies the densification threshold."""
        raise NotImplementedError

    def render(self, place: Place, out: Path) -> List[Command]:
        """Draw training and held-out views."""
        raise NotImplementedError

    def results(self, out: Path) -> Path:
        """The folder that the globs above are under."""
        return out


class Inria(Codebase):
    """graphdeco-inria/gaussian-splatting, with the settings of its full_eval.py."""

    name = "3dgs"
    threshold = 0.0002

    def train(self, place: Place, out: Path, preset: Optional[str], factor: float) -> List[Command]:
        """Train as full_eval.py does."""
        words = ["train.py", "-s", str(place.path), "-m", str(out), "--eval", "--quiet", "--test_iterations", "-1"]
        if place.dataset == "mipnerf360":
            words += ["-i", "images_2" if place.name in INDOOR else "images_4"]
        if factor != 1.0:
            words += ["--densify_grad_threshold", f"{factor * self.threshold:.6g}"]
        return [self.python(preset, words + self.extra)]

    def render(self, place: Place, out: Path) -> List[Command]:
        """Draw both sets, as 3DGS does by itself."""
        return [self.python(None, ["render.py", "-m", str(out), "--quiet"])]


class FastGS(Codebase):
    """fastgs/FastGS, with each scene's own settings out of the checkout's train_base.sh."""

    name = "fastgs"
    thresholds = {"--grad_thresh": 0.0002, "--grad_abs_thresh": 0.0012}

    def official(self, place: Place, script: str) -> List[str]:
        """The words that train_base.sh gives a scene, after its -s and -m."""
        text = (self.root / "train_base.sh").read_text(encoding="utf-8")
        if script == "train.py":
            found = re.search(rf"python train\.py -s \S*/{place.dataset}/{place.name}\s(.*)", text)
        else:
            found = re.search(rf"python render\.py -m \S*/{place.name}\s(.*)", text)
        if found is None:
            return ["--eval"] if script == "train.py" else []
        return [word for word in shlex.split(found.group(1)) if word != "--skip_train"]  # training views too

    def train(self, place: Place, out: Path, preset: Optional[str], factor: float) -> List[Command]:
        """Train as train_base.sh does."""
        words = ["train.py", "-s", str(place.path), "-m", str(out), *self.official(place, "train.py"), *self.extra]
        if factor != 1.0:
            for flag, default in self.thresholds.items():
                value = default
                if flag in words:
                    at = words.index(flag)
                    value = float(words[at + 1])
                    del words[at : at + 2]
                words += [flag, f"{factor * value:.6g}"]
        return [self.python(preset, words)]

    def render(self, place: Place, out: Path) -> List[Command]:
        """Draw both sets, with the scene's own box multiplier."""
        return [self.python(None, ["render.py", "-m", str(out), *self.official(place, "render.py")])]


class FasterGS(Codebase):
    """nerficg-project/faster-gaussian-splatting in a NeRFICG checkout, with the framework's own defaults."""

    name = "fastergs"
    render_folders = {"train": "inference/train_*/rgb", "test": "inference/test_*/rgb"}
    truth_folders = {"train": "inference/train_*/rgb_gt", "test": "inference/test_*/rgb_gt"}
    cloud = "**/*.ply"
    threshold = 0.0002

    def train(self, place: Place, out: Path, preset: Optional[str], factor: float) -> List[Command]:
        """Make a config, then train by it."""
        dataset = "MipNeRF360" if place.dataset == "mipnerf360" else "TanksAndTemples_3DGS"
        model = self._model(out)
        create = ["scripts/create_config.py", "-m", "FasterGS", "-d", dataset, "-o", model]
        settings = [f"TRAINING.MODEL_NAME={model}", f"DATASET.PATH={place.path}", "TRAINING.GUI.ACTIVATE=False"]
        if place.dataset == "mipnerf360":
            settings.append(f"DATASET.IMAGE_SCALE_FACTOR={0.5 if place.name in INDOOR else 0.25}")
        if factor != 1.0:
            settings.append(f"TRAINING.DENSIFICATION_GRAD_THRESHOLD={factor * self.threshold:.6g}")
        words = ["scripts/train.py", "-c", f"configs/{model}.yaml", *settings, *self.extra]
        return [self.python(None, create), self.python(preset, words)]

    def render(self, place: Place, out: Path) -> List[Command]:
        """Draw and score both sets, and write the .ply."""
        folder = str(self.results(out))
        draw = ["scripts/inference.py", "-d", folder, "-s", "train", "test", "-m"]
        return [self.python(None, draw), self.python(None, ["scripts/convert_to_ply.py", "-d", folder])]

    def results(self, out: Path) -> Path:
        """The newest of NeRFICG's folders of this name, which end with the time of the run."""
        found = sorted((self.root / "output" / "FasterGS").glob(f"{self._model(out)}_*"))
        return found[-1] if found else self.root / "output" / "FasterGS" / f"{self._model(out)}_DATE"

    @staticmethod
    def _model(out: Path) -> str:
        return "-".join(out.parts[-3:])


CODEBASES = {codebase.name: codebase for codebase in (Inria, FastGS, FasterGS)}
