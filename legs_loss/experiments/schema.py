"""The schema of a comparison's files, checked when they are read.

A comparison's folder may come from somebody else, and names in it become paths and text on a page.
"""

from __future__ import annotations

from typing import Any, Callable, Dict, Iterable, Mapping, Optional

from legs_loss.errors import LegsError
from legs_loss.experiments.arms import parse_arm
from legs_loss.reference.training.config import TrainConfig

__all__ = ["PLAN", "ROW", "SETTINGS", "what_is_wrong"]

# The required contents of the files.
SETTINGS = ("scene", "path", "images", "base", "baseline")
PLAN = ("arm", "seed", "config", "caps")
ROW = (*PLAN, "versions", "metrics")
_LARGEST = 1 << 63


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


def _number(value: Any) -> bool:
    return type(value) is float or (type(value) is int and abs(value) < _LARGEST)


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value < _LARGEST


def _text(value: Any) -> bool:
    return type(value) is str and "\0" not in value


def _scores(value: Any) -> bool:
    return isinstance(value, dict) and all(_text(name) and _number(score) for name, score in value.items())


def _optional(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or fits(value)


def _each(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and all(fits(one) for one in value)


def _of_names(fits: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(_text(name) and fits(one) for name, one in value.items())


def _with(fits: Callable[[Any], bool], *names: str) -> Callable[[Any], bool]:
    return lambda value: fits(value) and all(name in value for name in names)


def _pair(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_count, value))


def _config(value: Any) -> bool:
    """Return whether the class accepts the settings, and each has the type of its field."""
    return _alike(TrainConfig.from_dict(value).as_dict(), TrainConfig().as_dict())


def _alike(found: Mapping[str, Any], like: Mapping[str, Any]) -> bool:
    for name, value in like.items():
        if isinstance(value, dict):
            fits = isinstance(found[name], dict) and _alike(found[name], value)
        elif value is None:
            fits = found[name] is None or _number(found[name])
        else:
            fits = _number(found[name]) if _number(value) else type(found[name]) is type(value)
        if not fits:
            return False
    return True


def _metrics(value: Any) -> bool:
    whole = {
        "train": _optional(_with(_scores, "psnr")),
        "test": _optional(_with(_scores, "psnr")),
        "gaussians": _count,
        "mean_weight": _number,
        "seconds": _number,
        "processor_seconds": _number,
        "iterations": lambda number: _count(number) and number > 0,
        "growth": _each(_pair),
        "history": _each(_with(_scores, "iteration")),
        "views": _with(_of_names(_of_names(_scores)), "train", "test"),
    }
    needed = ("train", "test", "gaussians", "iterations", "growth", "history", "views")
    return all(name in value for name in needed) and all(
        fits(value[name]) for name, fits in whole.items() if name in value
    )


def _upstream(value: Any) -> bool:
    """Return whether what a row, or a comparison's settings, say of a codebase is valid."""
    row = {"profile": _text, "threshold_factor": _number, "pictures": _of_names(_text)}
    settings = {
        "profile": _text,
        "resolution": _optional(lambda number: type(number) is int),
        "iterations": _optional(_count),
        "gaussians": _optional(_count),
        "extra": _each(_text),
        "cpu": lambda flag: type(flag) is bool,
    }
    whole: Dict[str, Callable[[Any], bool]] = row if "threshold_factor" in value else settings
    return all(fits(value[name]) for name, fits in whole.items()) and isinstance(value.get("commands", {}), dict)


_FIELDS: Dict[str, Callable[[Any], bool]] = {
    "arm": lambda value: parse_arm(value).name == value,
    "seed": _count,
    "config": _config,
    "caps": _optional(_each(_pair)),
    "versions": _of_names(_text),
    "metrics": _metrics,
    "upstream": _upstream,
    "scene": lambda value: _text(value["name"]) and _text(value["sha256"]),
    "path": _text,
    "images": _optional(_text),
    "base": _config,
    "baseline": _optional(lambda value: isinstance(value, dict)),
}
