"""The schema of a comparison's files, checked when they are read.

A comparison's folder may come from somebody else, and names in it become paths and text on a page.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Iterable, Mapping, Optional

from legs_loss.errors import LegsError
from legs_loss.lab.experiments.arms import parse_arm
from legs_loss.lab.training.config import TrainConfig
from legs_loss.lab.values import each, is_pair, is_scores, of_names, optional, with_names
from legs_loss.system.values import is_count, is_number, is_text

# The required contents of the files.
SETTINGS = ("scene", "path", "images", "base", "baseline")
ROW = ("arm", "seed", "config", "caps", "versions", "metrics")


def what_is_wrong(values: Any, names: Iterable[str]) -> Optional[str]:
    """Return the name of a value that is missing or invalid in a file; None where the file is valid.

    Args:
        values: what the file holds.
        names: what it must hold.
    """
    if not isinstance(values, dict):
        return "all of it"
    for name in names:
        if name not in values:
            return name
    return next((name for name, fits in _FIELDS.items() if name in values and not _holds(fits, values[name])), None)


def _holds(fits: Callable[[Any], bool], value: Any) -> bool:
    try:
        return fits(value)
    except (LegsError, TypeError, ValueError, LookupError, AttributeError, RecursionError, OverflowError):
        return False


def _config(value: Any) -> bool:
    """Return whether the class accepts the settings, each has the type of its field, and what pages show is there."""
    default = TrainConfig().as_dict()
    known = _alike(TrainConfig.from_dict(value).as_dict(), default)
    return (
        known and set(default) - {"position_lr_max_steps"} <= set(value) and set(default["spec"]) <= set(value["spec"])
    )


def _alike(found: Mapping[str, Any], like: Mapping[str, Any]) -> bool:
    for name, value in like.items():
        if isinstance(value, dict):
            fits = isinstance(found[name], dict) and _alike(found[name], value)
        elif value is None:
            fits = found[name] is None or is_number(found[name])
        else:
            fits = is_number(found[name]) if is_number(value) else type(found[name]) is type(value)
        if not fits:
            return False
    return True


def _metrics(value: Any) -> bool:
    whole = {
        "train": optional(with_names(is_scores, "psnr")),
        "test": optional(with_names(is_scores, "psnr")),
        "gaussians": is_count,
        "mean_weight": is_number,
        "seconds": is_number,
        "processor_seconds": is_number,
        "iterations": lambda number: is_count(number) and number > 0,
        "growth": each(is_pair),
        "history": each(with_names(is_scores, "iteration")),
        "views": with_names(of_names(of_names(is_scores)), "train", "test"),
    }
    needed = ("train", "test", "gaussians", "iterations", "growth", "history", "views")
    return all(name in value for name in needed) and all(
        fits(value[name]) for name, fits in whole.items() if name in value
    )


def _proof(value: Any) -> bool:
    ours, theirs = ("views", "loss", "loss_3dgs", "gradient_error"), ("plain_calls", "weighted_calls")
    return with_names(is_scores, *(theirs if "plain_calls" in value else ours))(value)


def _upstream(value: Any) -> bool:
    """Return whether what a row, or a comparison's settings, say of a codebase is valid."""
    row = {"profile": is_text, "threshold_factor": is_number, "pictures": of_names(is_text)}
    settings = {
        "profile": is_text,
        "resolution": optional(lambda number: type(number) is int and is_number(number)),
        "iterations": optional(is_count),
        "gaussians": optional(is_count),
        "extra": each(is_text),
        "cpu": lambda flag: type(flag) is bool,
    }
    whole: Dict[str, Callable[[Any], bool]] = row if "threshold_factor" in value else settings
    return all(fits(value[name]) for name, fits in whole.items()) and isinstance(value.get("commands", {}), dict)


_FIELDS: Dict[str, Callable[[Any], bool]] = {
    "arm": lambda value: parse_arm(value).name == value,
    "seed": is_count,
    "config": _config,
    "caps": optional(each(is_pair)),
    "versions": of_names(is_text),
    "metrics": _metrics,
    "upstream": _upstream,
    "scene": lambda value: is_text(value["name"]) and is_text(value["sha256"]) and is_count(value["views"]),
    "path": is_text,
    "images": optional(is_text),
    "base": _config,
    "baseline": optional(_proof),
}
