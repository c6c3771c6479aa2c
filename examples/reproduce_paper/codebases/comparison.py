"""A comparison whose arms are trained by a codebase: with the same folder, rows and tables as the own trainer's.

OUT/upstream/                     the copy of the checkout that all trainings run in
OUT/comparison.json               the scene, the settings that all arms share, the profile
OUT/ARM/seed-N/row.json           a row with its scores
OUT/ARM/seed-N/output/            what the codebase wrote
OUT/ARM/seed-N/factor-X/          a trial of the control of the number of Gaussians, in place of output/
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple

from examples.reproduce_paper.codebases.profile import Profile
from examples.reproduce_paper.codebases.training import Checkout, check_copy, copy_checkout, train_and_score
from legs_loss.errors import LegsError
from legs_loss.lab.experiments.arms import BASELINE, ArmSpec, needed, parse_arm
from legs_loss.lab.experiments.running import Row, identity, read_json, versions, write_or_check
from legs_loss.lab.training.checkpoint import alone_in, write_json
from legs_loss.lab.training.dataset import load_view, split_views, weight_maps
from legs_loss.lab.training.trainer import TrainConfig
from legs_loss.scenes import Scene, read_scene, training_size
from legs_loss.spec import WeightSpec

__all__ = ["UpstreamComparison", "next_factor"]

CLOSE = 0.01  # of the number of Gaussians: what the count control is to meet
TRIALS = 6
CHANGES = ("mean1",)  # of arms: what a codebase can be told by the settings of its loss


class UpstreamComparison:
    """The comparison in a folder, new or existing.

    Args:
        root: a checkout of the codebase; nothing is written there.
        profile: how it is trained.
        scene: the scene's folder.
        out: the comparison's folder.
        images, resolution, iterations, gaussians, extra, cpu: as for :class:`Checkout`.

    Raises:
        LegsError: the checkout is patched, the scene cannot be read, the profile or the settings cannot be used, or the
            folder holds another comparison, or one of another checkout.
    """

    def __init__(
        self,
        root: Path,
        profile: Profile,
        scene: Path,
        out: Path,
        images: Optional[str] = None,
        resolution: Optional[int] = None,
        iterations: Optional[int] = None,
        gaussians: Optional[int] = None,
        extra: Sequence[str] = (),
        cpu: bool = False,
    ) -> None:
        self.out: Path = Path(out)
        self.profile: Profile = profile
        self.scene: Scene = read_scene(scene, images)
        if profile.number and gaussians is None:
            raise LegsError(f"{profile.name} trains to a fixed number of Gaussians: give it with --gaussians")
        points = 0 if self.scene.points is None else len(self.scene.points.xyz)
        if profile.number and gaussians is not None and gaussians <= points:
            raise LegsError(
                f"{profile.name} starts with the scene's {points:,} points and grows: give more with --gaussians, "
                f"not {gaussians:,}"
            )
        size = 1 if profile.scales else -1  # the codebase's own, for the mean weights
        base = TrainConfig(
            spec=BASELINE,
            iterations=profile.iterations if iterations is None else iterations,
            resolution=size if resolution is None else resolution,
        )
        training_size(1 << 20, 1 << 20, base.resolution)
        settings = {
            "scene": identity(self.scene),
            "path": str(Path(scene).resolve()),
            "images": images,
            "base": base.as_dict(),
            "baseline": None,
            "upstream": {
                "profile": profile.name,
                "commands": json.loads(json.dumps(asdict(profile))),
                "resolution": resolution,
                "iterations": iterations,
                "gaussians": gaussians,
                "extra": list(extra),
                "cpu": cpu,
            },
        }
        self.base = base
        copy, edits = self.out / "upstream", profile.edits(Path(scene).resolve(), resolution)
        self.checkout: Checkout = Checkout(
            copy.resolve(), profile, Path(scene).resolve(), images, resolution, iterations, gaussians, extra, cpu
        )
        self.checkout.check()
        path = self.out / "comparison.json"
        with alone_in(self.out, make=True):
            if path.is_file():  # else it is written last: a checkout that cannot be copied leaves none
                write_or_check(path, settings, tuple(settings), ("path", "baseline"))
            check_copy(root, copy, edits) if copy.is_dir() else copy_checkout(root, copy, edits)
            write_or_check(path, settings, tuple(settings), ("path", "baseline"))
        self._mean_weights: Dict[WeightSpec, float] = {}

    def check(self, arms: Sequence[ArmSpec]) -> None:
        """Raise a LegsError for an arm that a codebase cannot train, before anything is trained."""
        for arm in arms:
            other = [change for change in arm.changes if change not in CHANGES]
            if other:
                raise LegsError(
                    f"{arm.name}: {other[0]} needs the package's own trainer; here there are {', '.join(CHANGES)}"
                )
            if arm.at is not None and self.profile.number:
                raise LegsError(f"{arm.name}: with {self.profile.name} every arm has as many Gaussians as every other")
            if arm.at is not None and not self.profile.threshold:
                raise LegsError(f"{arm.name}: the profile {self.profile.name} names no threshold to change")

    def row(self, arm: ArmSpec, seed: int) -> Optional[Row]:
        """Return the row of an arm and seed, None if it is not trained yet."""
        path = self._folder(arm, seed) / "row.json"
        return read_json(path, ("arm", "seed", "metrics")) if path.is_file() else None

    def train(self, arms: Sequence[ArmSpec], seeds: Sequence[int], tell: Callable[[str], None]) -> List[Row]:
        """Train the rows that are missing, one after the other; return all, seed by seed.

        Raises:
            LegsError: a training failed; finished rows are kept, and the next call resumes.
        """
        self.check(arms)
        rows = []
        for seed in seeds:
            for arm in needed([parse_arm(BASELINE), *arms]):
                row = self.row(arm, seed)
                if row is None:
                    folder = self._folder(arm, seed)
                    with alone_in(folder, make=True):
                        row = self.row(arm, seed) or self._train(arm, seed, tell)  # another may have trained it since
                        write_json(folder / "row.json", row)
                if arm.name == BASELINE and seed == seeds[0]:
                    self._prove(row)
                rows.append(row)
        return rows

    def mean_weight(self, spec: WeightSpec) -> float:
        """Return the mean weight of a spec's maps over the training views."""
        if spec not in self._mean_weights:
            images = (load_view(self.scene, view, self.base.resolution).image for view in split_views(self.scene)[0])
            means = [float(weight.double().mean()) for weight in weight_maps(images, spec)]
            self._mean_weights[spec] = sum(means) / len(means)
        return self._mean_weights[spec]

    def _prove(self, row: Row) -> None:
        """Record the evidence that the baseline is the codebase's own loss."""
        proof = {name: row["metrics"][name] for name in ("weighted_calls", "plain_calls")}
        path = self.out / "comparison.json"
        settings = read_json(path, ("scene", "upstream", "baseline"))
        if settings["baseline"] != proof:
            write_json(path, dict(settings, baseline=proof))

    def _folder(self, arm: ArmSpec, seed: int) -> Path:
        return self.out / arm.folder / f"seed-{seed}"

    def _train(self, arm: ArmSpec, seed: int, tell: Callable[[str], None]) -> Row:
        spec, folder = arm.spec, self._folder(arm, seed)
        if arm.at is None:
            tell(f"{arm.name}, seed {seed}")
            return self._row(arm, seed, spec, 1.0, train_and_score(self.checkout, spec, seed, folder, 1.0))
        leader = self.row(parse_arm(arm.at), seed)
        assert leader is not None  # trained before, see `needed`
        wanted = leader["metrics"]["gaussians"]
        # The search begins at the same loss's own number, and at what the seed before needed.
        known = [row for row in (self._plain(arm, seed), self.row(arm, seed - 1)) if row is not None]
        tried = [(float(row["upstream"]["threshold_factor"]), int(row["metrics"]["gaussians"])) for row in known]
        best: Optional[Tuple[float, Dict[str, Any]]] = None
        for _ in range(TRIALS):
            factor = next_factor(tried, wanted)
            tell(f"{arm.name}, seed {seed}: thresholds times {factor:.4g} for {wanted:,} Gaussians")
            metrics = train_and_score(self.checkout, spec, seed, folder / f"factor-{factor:.6g}", factor)
            tried.append((factor, metrics["gaussians"]))
            if best is None or abs(math.log(metrics["gaussians"] / wanted)) < abs(
                math.log(best[1]["gaussians"] / wanted)
            ):
                best = factor, metrics
            if abs(best[1]["gaussians"] / wanted - 1) <= CLOSE:
                break
        assert best is not None
        return self._row(arm, seed, spec, best[0], best[1])

    def _plain(self, arm: ArmSpec, seed: int) -> Optional[Row]:
        """Return the row of the same loss at its own number, where it is there."""
        return self.row(replace(arm, name=arm.name.partition("@")[0], at=None), seed)

    def _row(self, arm: ArmSpec, seed: int, spec: WeightSpec, factor: float, metrics: Dict[str, Any]) -> Row:
        threshold = next((factor * value for value in self.checkout.thresholds()), None)
        config = replace(self.base, spec=spec, seed=seed, densify_grad_threshold=threshold)
        mean = 1.0 if spec.unweighted else self.mean_weight(spec)
        pictures = [os.path.relpath(path, str(self._folder(arm, seed).resolve())) for path in metrics.pop("pictures")]
        held_out = [view.name for view in split_views(self.scene)[1]]
        if len(held_out) != len(pictures):  # the codebase holds other views out
            held_out = []
        return {
            "arm": arm.name,
            "seed": seed,
            "config": config.as_dict(),
            "caps": None,
            "upstream": {
                "profile": self.profile.name,
                "threshold_factor": factor,
                "pictures": dict(zip(held_out, pictures)),
            },
            "versions": versions(),
            "metrics": dict(metrics, mean_weight=mean),
        }


def next_factor(tried: Sequence[Tuple[float, int]], wanted: int) -> float:
    """Return the next factor of the thresholds, from those tried and the Gaussians that they led to.

    By a line through the two nearest in logarithms, and never more than ten times away from the nearest.

    >>> next_factor([], 200), next_factor([(1.0, 100)], 200), next_factor([(1.0, 400)], 200)
    (1.0, 0.5, 2.0)
    >>> round(next_factor([(1.0, 100), (0.5, 200)], 400), 3)  # the number goes with 1 / factor
    0.25
    """
    if not tried:
        return 1.0
    nearest = sorted(dict(tried).items(), key=lambda one: abs(math.log(one[1] / wanted)))
    first, first_count = nearest[0]
    if len(nearest) == 1:
        return first * (0.5 if first_count < wanted else 2.0)
    second, second_count = nearest[1]
    if first_count == second_count:
        return first * (0.7 if first_count < wanted else 1.4)
    slope = math.log(first / second) / math.log(first_count / second_count)
    factor = first * math.exp(slope * math.log(wanted / first_count))
    return min(10.0 * first, max(0.1 * first, factor))
