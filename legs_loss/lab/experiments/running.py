"""A comparison in a folder: its settings, and one row for each arm and seed.

OUT/comparison.json              the scene and the settings that all arms share, the proof of the baseline
OUT/ARM/seed-N/row.json          the row's complete settings and its scores, once it is trained
OUT/ARM/seed-N/point_cloud/...   its Gaussians
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple

import numpy as np

from legs_loss._version import __version__
from legs_loss.errors import LegsError
from legs_loss.lab.experiments.arms import BASELINE, ArmSpec, needed, parse_arm
from legs_loss.lab.experiments.baseline import prove_unweighted
from legs_loss.lab.experiments.schema import ROW, SETTINGS, what_is_wrong
from legs_loss.lab.training.checkpoint import CHECKPOINT, alone_in, write_json
from legs_loss.lab.training.dataset import Dataset, load_dataset, weight_maps
from legs_loss.lab.training.perceptual import network_name, use_lpips
from legs_loss.lab.training.side_by_side import Arm, train_side_by_side
from legs_loss.lab.training.trainer import Progress, TrainConfig, default_threshold
from legs_loss.scenes import Scene, read_scene
from legs_loss.spec import WeightSpec
from legs_loss.system.files import read_regular
from legs_loss.weights import Weights

_LARGEST = 256 << 20  # bytes of a file of a comparison
EVALUATIONS = 10  # of the held-out views during a run, for the plots

Row = Dict[str, Any]


class Comparison:
    """The comparison in a folder, new or existing.

    Args:
        scene: a COLMAP scene.
        base: the settings that all arms share; its spec does not count, each row has its own seed.
        out: the comparison's folder.
        images: the folder of the photographs, as :func:`~legs_loss.scenes.read_scene` takes it.
        lpips: the weights of LPIPS's network, as :func:`~legs_loss.lab.training.perceptual.use_lpips` takes them.

    Raises:
        LegsError: the scene cannot be trained on, the baseline is weighted, the folder holds another comparison, or the
            weights are not such a network's.
    """

    def __init__(
        self, scene: Path, base: TrainConfig, out: Path, images: Optional[str] = None, lpips: Optional[Path] = None
    ) -> None:
        use_lpips(lpips)
        self.lpips: Optional[Path] = None if lpips is None else Path(os.path.abspath(str(lpips)))
        self.root: Path = Path(os.path.abspath(str(scene)))
        self.images: Optional[str] = images
        self.out: Path = Path(os.path.abspath(str(out)))
        self.scene: Scene = read_scene(self.root, images)
        self.base: TrainConfig = replace(base, spec=BASELINE, seed=0)
        self.data: Dataset = load_dataset(self.scene, self.base.weights, base.resolution, base.white_background)
        self._mean_weights: Dict[WeightSpec, float] = {}
        self.threshold: float = base.densify_grad_threshold or default_threshold(self.data.train)
        self._begin()

    def mean_weight(self, spec: WeightSpec) -> float:
        """Return the mean weight of a spec's maps over what counts of the training views."""
        if spec not in self._mean_weights:
            maps = zip(self.data.train, weight_maps((view.image for view in self.data.train), spec))
            means = [Weights(map=weight).masked(view.mask).mean_weight() for view, weight in maps]
            self._mean_weights[spec] = sum(means) / len(means)
        return self._mean_weights[spec]

    def folder(self, arm: ArmSpec, seed: int) -> Path:
        """Return the folder of a row."""
        return self.out / arm.folder / f"seed-{seed}"

    def row(self, arm: ArmSpec, seed: int) -> Optional[Row]:
        """Return the row of an arm and seed, None if it is not trained yet."""
        path = self.folder(arm, seed) / "row.json"
        return read_json(path, ROW) if path.is_file() else None

    def train(
        self,
        arms: Sequence[ArmSpec],
        seeds: Sequence[int],
        processes: int,
        on_progress: Callable[[str, Progress], None],
        scheduler: Optional[str] = None,
    ) -> List[Row]:
        """Train the rows that are missing, in processes with one thread each; return all, seed by seed.

        With ``scheduler``, the address of a dask scheduler, its workers train them.

        Arms whose numbers of Gaussians others use are trained too, before them.

        Raises:
            LegsError: a training failed; finished rows are kept, and the next call resumes.
        """
        todo = [(arm, seed) for seed in seeds for arm in needed(arms)]
        for late in (False, True):  # arms that use another arm's numbers are trained after it
            plans = {
                f"{arm.name}, seed {seed}": (arm, seed)
                for arm, seed in todo
                if (arm.at is not None) == late and self.row(arm, seed) is None
            }
            trainings = [self._training(name, arm, seed) for name, (arm, seed) in plans.items()]

            def done(name: str, metrics: Dict[str, Any], plans: Mapping[str, Tuple[ArmSpec, int]] = plans) -> None:
                arm, seed = plans[name]
                self._finish(arm, seed, metrics)

            if trainings:
                train_side_by_side(trainings, processes, on_progress, done, scheduler)
        rows = [self.row(arm, seed) for seed in seeds for arm in needed(arms)]
        return [row for row in rows if row is not None]

    def _training(self, name: str, arm: ArmSpec, seed: int) -> Arm:
        """Return the training of a row; it resumes from a checkpoint in its folder."""
        config, caps = self._config(arm, seed)
        every = max(1, config.iterations // EVALUATIONS)
        images = os.path.abspath(self.images) if self.images and os.path.isdir(self.images) else self.images
        folder = self.folder(arm, seed)
        return Arm(
            name, self.root, config, folder, images, caps=caps, evaluate_every=every, resume=None, lpips=self.lpips
        )

    def _config(self, arm: ArmSpec, seed: int) -> Tuple[TrainConfig, Optional[Dict[int, int]]]:
        mean_weight = self.mean_weight(arm.spec) if arm.needs_mean_weight else 1.0
        config = arm.config(replace(self.base, seed=seed), self.threshold, mean_weight)
        if arm.at is None:
            return config, None
        leader = self.row(parse_arm(arm.at), seed)
        if leader is None:
            raise LegsError(f"{arm.name}, seed {seed}, uses the numbers of {arm.at}: train that first")
        return config, {int(iteration): int(count) for iteration, count in leader["metrics"]["growth"]}

    def _finish(self, arm: ArmSpec, seed: int, metrics: Dict[str, Any]) -> None:
        folder = self.folder(arm, seed)
        if arm.name == BASELINE and abs(metrics["mean_weight"] - 1.0) > 1e-6:  # a mask over its mean
            raise LegsError(f"the baseline was trained with weights of mean {metrics['mean_weight']}")
        if self.row(arm, seed) is None:  # another comparison in this folder may have trained it, too
            config, caps = self._config(arm, seed)
            row = {
                "arm": arm.name,
                "seed": seed,
                "config": config.as_dict(),
                "caps": None if caps is None else sorted(caps.items()),
                "versions": {**versions(), **({"lpips": network_name()} if self.lpips is not None else {})},
                "metrics": metrics,
            }
            write_json(folder / "row.json", row)
        with suppress(FileNotFoundError):
            (folder / CHECKPOINT).unlink()

    def _begin(self) -> None:
        settings = {
            "scene": identity(self.scene),
            "path": str(self.root),
            "images": self.images,
            "base": replace(self.base, densify_grad_threshold=self.threshold).as_dict(),
        }
        path = self.out / "comparison.json"
        # Each time: a resumed comparison may run with newer code.
        self.proof: Dict[str, Any] = prove_unweighted(self.data.train, self.base)
        with alone_in(self.out, make=True):
            write_or_check(path, dict(settings, baseline=self.proof), SETTINGS, ("path", "baseline"))
        write_json(path, dict(read_json(path, SETTINGS), baseline=self.proof))


def read_rows(out: Path) -> Tuple[Dict[str, Any], List[Row]]:
    """Return a comparison's settings and its rows, by arm and seed.

    Raises:
        LegsError: the folder holds no comparison, or none of its rows is trained.
    """
    if not (out / "comparison.json").is_file():
        raise LegsError(f"{out}: there is no comparison here (comparison.json): `legs compare` makes one")
    rows = [read_json(path, ROW) for path in sorted(out.glob("*/seed-*/row.json"))]
    if not rows:
        raise LegsError(f"{out}: none of this comparison's rows is trained yet")
    return read_json(out / "comparison.json", SETTINGS), sorted(rows, key=lambda row: (row["arm"], row["seed"]))


def scene_of(settings: Mapping[str, Any], moved: Optional[Path] = None) -> Scene:
    """Return the scene of a comparison with these settings; ``moved`` is its new folder.

    Raises:
        LegsError: it is not there, or it is another scene.
    """
    root = Path(settings["path"]) if moved is None else moved
    if not root.is_dir():
        raise LegsError(f"{root}: the scene is not there: give its new folder with --scene")
    scene = read_scene(root, settings["images"])
    if identity(scene)["sha256"] != settings["scene"]["sha256"]:
        raise LegsError(f"{root}: this is not the scene of the comparison: it has other views or points")
    return scene


def versions() -> Dict[str, str]:
    """Return the versions of all software that a result may depend on."""
    import numba
    import torch

    return {
        "legs_loss": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "machine": f"{platform.system()} {platform.machine()}",
        "code": _code(),
    }


def _code() -> str:
    """Return a checksum of this package's sources, which change between versions and change the rounding."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[2]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def identity(scene: Scene) -> Dict[str, Any]:
    """Return an identification of a scene that does not depend on its folder."""
    digest = hashlib.sha256("\n".join(view.name for view in scene.views).encode())
    if scene.points is not None:
        digest.update(np.ascontiguousarray(scene.points.xyz).tobytes())
    return {"name": scene.root.resolve().name, "views": len(scene.views), "sha256": digest.hexdigest()[:16]}


def write_or_check(path: Path, values: Dict[str, Any], names: Sequence[str], free: Sequence[str] = ()) -> None:
    """Write values, or check them against an existing file; those of the names in ``free`` may differ."""
    if not path.is_file():
        write_json(path, values)
        return
    there = read_json(path, names)
    different = [
        name for name, text in _flat(values) if name.split(".")[0] not in free and dict(_flat(there)).get(name) != text
    ]
    if different:
        raise LegsError(
            f"{path}: this comparison was started with another {', '.join(different)}: choose another folder (--out), "
            "or give the settings that it has"
        )


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[Tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def read_json(path: Path, names: Sequence[str]) -> Dict[str, Any]:
    """Return the values of a JSON file of a comparison that must have these names.

    Raises:
        LegsError: it cannot be read, or is damaged; the message names the part.
    """
    try:
        values = json.loads(read_regular(path, _LARGEST).decode("utf-8"))
    except OSError as error:
        raise LegsError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        values = None
    wrong = what_is_wrong(values, names)
    if wrong is not None:
        raise LegsError(f"{path}: this file is damaged ({wrong}): delete it and run the comparison again")
    return values
