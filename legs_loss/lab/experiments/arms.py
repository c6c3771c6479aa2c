"""An arm's name, and the training that it describes.

    LOSS[:CHANGE ...][@ARM]

LOSS is a preset ("legs"), a curve with LEGS's other settings ("C4"), a beta with them ("beta=5"), or settings of a
WeightSpec ("curve=C3,beta=4,percentile=99"). CHANGE is one of CHANGES: "legs:shuffled". @ARM gives it the number of
Gaussians of another arm, densification by densification: "legs@3dgs".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple

from legs_loss.curves import curve_names
from legs_loss.errors import LegsError
from legs_loss.spec import PRESETS, WeightSpec

if TYPE_CHECKING:
    from legs_loss.lab.training.trainer import TrainConfig

BASELINE = "3dgs"

# The changes, with their descriptions for the help and the tables.
CHANGES: Mapping[str, str] = {
    "scale": "no map: the L1 term times the loss's mean weight",
    "shuffled": "each map's pixels in random order",
    "mean1": "each map divided by its mean",
    "lambda=X": "the share X of D-SSIM in the loss",
    "threshold": "the densification threshold times the loss's mean weight",
    "until=N": "weights to iteration N, the plain loss after it",
    "from=N": "the plain loss to iteration N, weights after it",
}

# The built-in lists of arms.
STUDIES: Mapping[str, Tuple[str, ...]] = {
    "main": ("eggs", "legs-l", "legs"),
    "controls": (
        *("legs", "legs:scale", "legs:shuffled", "legs:mean1", "legs:threshold"),
        *("3dgs@legs", "legs@3dgs", "legs:mean1@3dgs"),
    ),
}

LOOSE = 0.25  # of the threshold: low enough that another arm's numbers are reached


@dataclass(frozen=True)
class ArmSpec:
    """An arm, parsed from its name."""

    name: str
    spec: WeightSpec
    changes: Tuple[str, ...] = ()
    at: Optional[str] = None  # the arm whose numbers of Gaussians this one gets
    settings: Tuple[Tuple[str, float], ...] = ()  # of a training that the changes name

    @property
    def folder(self) -> str:
        """Return the name as a folder's, on any system."""
        return self.name.replace(":", "-").replace("@", "-at-").replace("=", "-").replace(",", "-")

    @property
    def reference(self) -> Optional[str]:
        """Return the arm that this is measured against: the one whose numbers the unweighted loss gets, else 3dgs."""
        if self.name == BASELINE:
            return None
        return self.at if self.at is not None and self.spec.unweighted else BASELINE

    @property
    def needs_mean_weight(self) -> bool:
        """Return whether :meth:`config` needs the mean weight of the spec's maps."""
        return "scale" in self.changes or "threshold" in self.changes

    def config(self, base: TrainConfig, threshold: float, mean_weight: float) -> TrainConfig:
        """Return the arm's settings.

        Args:
            base: what all arms share; its spec does not count.
            threshold: the densification threshold that all arms share.
            mean_weight: of the spec's maps over the training views.
        """
        if "threshold" in self.changes:
            threshold *= mean_weight
        if self.at is not None:
            threshold *= LOOSE
        if "scale" in self.changes:
            return replace(base, spec="3dgs", l1_scale=base.l1_scale * mean_weight, densify_grad_threshold=threshold)
        shuffled = "shuffled" in self.changes
        named: Dict[str, Any] = dict(self.settings)
        return replace(base, spec=self.spec, shuffled=shuffled, densify_grad_threshold=threshold, **named)


def parse_arm(name: str) -> ArmSpec:
    """Return the arm of this name; one that a preset names too gets the preset's name.

    Raises:
        LegsError: a part of the name is unknown.

    >>> arm = parse_arm("legs:mean1@3dgs")
    >>> arm.spec.normalise, arm.at
    ('mean', '3dgs')
    >>> parse_arm("C1").name, parse_arm("beta=0").name, parse_arm("beta=5").name
    ('legs-l', '3dgs', 'beta=5')
    """
    before, at_sign, at = name.partition("@")
    loss, *changes = before.split(":")
    settings = _settings(name, changes)
    for change in changes:
        if change not in CHANGES and ("=" not in change or change.partition("=")[0] not in _NUMBERS):
            raise LegsError(f"{name}: no change is named {change!r}: choose one of {', '.join(CHANGES)}")
    if len(set(changes)) < len(changes):
        raise LegsError(f"{name}: give each change once")
    if "scale" in changes and len(changes) > 1:
        raise LegsError(f"{name}: scale uses no map, so no other change applies")
    if at_sign and "@" in at:
        raise LegsError(f"{name}: the arm after @ must not contain an @")
    spec = _loss(name, loss)
    if spec.unweighted and any(not change.startswith("lambda=") for change in changes):
        raise LegsError(f"{name}: {loss} has no weights to change")
    leader = parse_arm(at).name if at_sign else None
    preset = next((preset for preset, known in PRESETS.items() if known == spec), loss)
    changed = ":".join([preset, *changes])
    if "mean1" in changes:
        spec = replace(spec, normalise="mean")
    return ArmSpec(changed if leader is None else f"{changed}@{leader}", spec, tuple(changes), leader, settings)


def parse_arms(names: Sequence[str]) -> List[ArmSpec]:
    """Return the arms of these names, each once, in order.

    Raises:
        LegsError: a name is wrong.
    """
    return list(dict.fromkeys(parse_arm(name) for name in names))


def needed(arms: Sequence[ArmSpec]) -> List[ArmSpec]:
    """Return the arms, and before them those whose numbers of Gaussians they use."""
    return list(dict.fromkeys([parse_arm(arm.at) for arm in arms if arm.at is not None] + list(arms)))


def these_arms(names: Sequence[str]) -> List[str]:
    """Return the arms of a table: the baseline, those whose numbers others get, and the named ones under these names.

    >>> these_arms(["C4", "3dgs@legs"])
    ['3dgs', 'legs', 'C4', '3dgs@legs']
    """
    given = {parse_arm(name).name: name for name in names}
    arms = sorted(needed(parse_arms([BASELINE, *names])), key=lambda arm: arm.name != BASELINE)  # else as they were
    return [given.get(arm.name, arm.name) for arm in arms]


def _settings(name: str, changes: Sequence[str]) -> Tuple[Tuple[str, float], ...]:
    found: Dict[str, float] = {}
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or key not in _NUMBERS:
            continue
        setting, kind, fits, wanted = _NUMBERS[key]
        if setting in found:
            raise LegsError(f"{name}: give {key} once")
        try:
            found[setting] = kind(text)
        except ValueError:
            found[setting] = math.nan
        if not fits(found[setting]):
            raise LegsError(f"{name}: {key} must be {wanted}, got {text!r}")
    return tuple(found.items())


def _loss(name: str, loss: str) -> WeightSpec:
    if loss in PRESETS:
        return PRESETS[loss]
    if loss in curve_names():
        return WeightSpec(curve=loss)
    settings: Dict[str, Any] = {}
    for part in loss.split(","):
        key, equals, value = part.partition("=")
        if not equals or key not in _FIELDS:
            raise LegsError(
                f"{name}: {part!r} is not a loss: give a preset ({', '.join(PRESETS)}), a curve "
                f"({', '.join(curve_names())}) or settings of a spec such as beta=5 or curve=C3,percentile=99 "
                f"({', '.join(_FIELDS)})"
            )
        try:
            settings[key] = _FIELDS[key](value)
        except ValueError:
            raise LegsError(f"{name}: {key} must be a number, got {value!r}") from None
    return WeightSpec(**settings)


# The changes that have a number: the setting of a training, its type, what it may be.
_NUMBERS: Mapping[str, Tuple[str, Callable[[str], float], Callable[[float], bool], str]] = {
    "lambda": ("lambda_dssim", float, lambda value: 0.0 <= value <= 1.0, "a number in [0, 1]"),
    "until": ("weights_until", int, lambda value: value >= 1, "a whole number of at least 1"),
    "from": ("weights_from", int, lambda value: value >= 1, "a whole number of at least 1"),
}
_FIELDS: Mapping[str, Callable[[str], Any]] = {field.name: type(field.default) for field in fields(WeightSpec)}
