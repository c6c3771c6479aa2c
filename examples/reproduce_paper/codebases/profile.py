"""Read how a codebase is trained and rendered from a TOML file: one a codebase in profiles/, or a user's own."""

from __future__ import annotations

import re
import shlex
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple

from legs_loss.errors import LegsError
from legs_loss.system.files import read_regular

__all__ = ["PROFILES", "Edit", "Profile", "Threshold", "fill", "find_profile", "read_profile", "split"]

PROFILES = Path(__file__).with_name("profiles")
_LARGEST = 1 << 20  # bytes of a profile


@dataclass(frozen=True)
class Threshold:
    """The option for the densification threshold: its words with {value}, and its default value."""

    words: str
    value: float

    def given(self, words: Sequence[str]) -> Optional[float]:
        """Return the value that the words of a command give it, None where they do not.

        >>> Threshold("--grad {value}", 0.1).given(["-r", "2", "--grad", "0.3"])
        0.3
        >>> Threshold("TRAINING.GRAD={value}", 0.1).given(["TRAINING.GRAD=0.2"])
        0.2
        """
        pattern = re.escape(self.words).replace(r"\{value\}", r"(\S+)").replace(r"\ ", r"[ =]")
        found = re.findall(rf"(?:^| ){pattern}(?= |$)", " ".join(words))
        try:
            return float(found[-1]) if found else None
        except ValueError:
            return None


@dataclass(frozen=True)
class Edit:
    """A text of a file that is replaced in the copy of the checkout; in a profile ``new`` has {scene} and {scale}."""

    file: str
    old: str
    new: str


@dataclass(frozen=True)
class Profile:
    """A codebase's own commands. A command is a script of the checkout and its arguments, with placeholders.

    Attributes:
        name: the codebase's.
        files: those that a checkout of it has.
        text: a file's name, and a text in it that distinguishes this codebase from others with the same files.
        iterations: of a training that is not told how many.
        train: commands, of which the last one trains. {scene}, {output} and {name} (of the run) are filled in.
        images, resolution: words for a folder of photographs {images} and 3DGS's -r {resolution}; "" where it has none.
        shorter: words for a run of {iterations}, with 3DGS's schedule in proportion: {densify_from}, {densify_until},
            {densify_every}, {reset_every}; "" where it cannot be told.
        number: words for a fixed number of {gaussians}, for codebases that have as many whatever the loss.
        results: where a run lies in the checkout, a pattern with {name}; "" where it is {output}.
        render: commands that draw the training and the held-out views; {results} is filled in too.
        renders, truths: by "train" and "test", the folders of the drawn views and of their photographs, as patterns.
        cloud: the .ply of the Gaussians, as a pattern.
        threshold: the options that the control of the number of Gaussians changes, all by one factor.
        edit: what no option says, for codebases whose scripts read some settings from a file alone. {scene} is filled
            in, and {scale}: -r as a factor, null for 1. With {scale} there are -r 1, 2, 4 and 8, and 1 is the default.
    """

    name: str
    files: Tuple[str, ...]
    text: Mapping[str, str]
    iterations: int
    train: Tuple[str, ...]
    render: Tuple[str, ...]
    renders: Mapping[str, str]
    truths: Mapping[str, str]
    cloud: str
    images: str = ""
    resolution: str = ""
    shorter: str = ""
    number: str = ""
    results: str = ""
    threshold: Tuple[Threshold, ...] = ()
    edit: Tuple[Edit, ...] = ()

    def fits(self, root: Path) -> bool:
        """Return whether a checkout is of this codebase."""
        return all((root / name).is_file() for name in self.files) and all(
            (root / name).is_file() and words in (root / name).read_text(encoding="utf-8", errors="replace")
            for name, words in self.text.items()
        )

    @property
    def scales(self) -> bool:
        """Return whether the size of the photographs is told by an edit."""
        return any("{scale}" in edit.new for edit in self.edit)

    def edits(self, scene: Path, resolution: Optional[int] = None) -> List[Edit]:
        """Return the edits for a scene and 3DGS's -r."""
        scale = "null" if resolution in (None, 1) else repr(1.0 / (resolution or 1))
        return [
            replace(edit, new=edit.new.replace("{scale}", scale).replace("{scene}", str(scene))) for edit in self.edit
        ]


def read_profile(path: Path) -> Profile:
    """Read a profile; missing settings are those of the built-in profile that it ``extends``, if any.

    Raises:
        LegsError: it cannot be read, or something in it is missing, unknown or of the wrong kind.
    """
    return _profile(path, _read(path))


def find_profile(root: Path, wanted: Optional[str] = None) -> Profile:
    """Return the profile of a checkout.

    Args:
        root: the checkout.
        wanted: a built-in profile's name or the path of a TOML file; None: the built-in one that fits.

    Raises:
        LegsError: none fits, or the one that was asked for cannot be read.
    """
    built_in = {path.stem: path for path in sorted(PROFILES.glob("*.toml"))}
    if wanted is not None:
        path = built_in.get(wanted, Path(wanted))
        if not path.exists():
            raise LegsError(f"{wanted} is no file, nor a built-in profile ({', '.join(built_in)})")
        return read_profile(path)
    fitting = [profile for profile in map(read_profile, built_in.values()) if profile.fits(root)]
    # A fork of 3DGS has 3DGS's options too: the fork's own profile is more specific.
    fitting = [profile for profile in fitting if profile.name != "3dgs"] or fitting
    if len(fitting) != 1:
        found = " and ".join(profile.name for profile in fitting) or "none"
        raise LegsError(
            f"{root}: of the built-in profiles ({', '.join(built_in)}) {found} fit: name one with --profile, or a TOML "
            'file that says how this codebase is trained; two lines do for a fork of 3DGS: name and extends = "3dgs"'
        )
    return fitting[0]


def _profile(path: Path, values: Dict[str, Any]) -> Profile:
    parent = values.pop("extends", None)
    if parent is not None:
        base = PROFILES / f"{parent}.toml"
        if not base.is_file():
            raise LegsError(f"{path}: there is no built-in profile {parent!r} to extend")
        values = {**_read(base), **values}
    kinds = {field.name: str(field.type) for field in fields(Profile)}
    for name, value in values.items():
        if name not in kinds:
            raise LegsError(f"{path}: unknown setting {name!r}; there are {', '.join(kinds)}")
        if not _is(value, kinds[name]):
            raise LegsError(f"{path}: {name} has an invalid value: {value!r}")
    missing = [field.name for field in fields(Profile) if field.name not in values and not _has_default(field)]
    if missing:
        raise LegsError(f"{path}: {', '.join(missing)} missing")
    for name in ("train", "render"):
        if not values[name]:
            raise LegsError(f"{path}: {name} must have a command")
    for name in ("renders", "truths"):
        if set(values[name]) != {"train", "test"}:
            raise LegsError(f"{path}: {name} must have train and test")
    made: Dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    made["threshold"] = _tables(path, Threshold, values.get("threshold", ()))
    made["edit"] = _tables(path, Edit, values.get("edit", ()))
    for threshold in made["threshold"]:
        if "{value}" not in threshold.words:
            raise LegsError(f"{path}: a threshold has words with {{value}}: {threshold.words!r}")
    return Profile(**made)


def _tables(path: Path, kind: Any, given: Sequence[Dict[str, Any]]) -> Tuple[Any, ...]:
    """Return the tables of a list in a profile as objects of a kind."""
    kinds = {field.name: str(field.type) for field in fields(kind)}
    for one in given:
        if set(one) != set(kinds) or not all(_is(one[name], kinds[name]) for name in kinds):
            raise LegsError(f"{path}: in {kind.__name__.lower()} each table has {', '.join(kinds)}: {one!r}")
    return tuple(kind(**one) for one in given)


def fill(words: str, places: Mapping[str, Any]) -> List[str]:
    """Return words with their placeholders replaced; replaced values are never split.

    >>> fill("train.py -s {scene} --lr {value:.2g}", {"scene": "my scene", "value": 0.00123})
    ['train.py', '-s', 'my scene', '--lr', '0.0012']
    """
    unknown = sorted(set(re.findall(r"{(\w+)", words)) - set(places))
    if unknown:
        raise LegsError(f"{words!r}: {{{unknown[0]}}} is unknown; there are {', '.join(sorted(places))}")
    parts = split(words)
    try:
        return [word.format(**places) for word in parts]
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise LegsError(f"{words!r} cannot be filled in: {error}") from None


def split(words: str) -> List[str]:
    """Split words as a shell does.

    Raises:
        LegsError: a quotation is not closed.
    """
    try:
        return shlex.split(words)
    except ValueError as error:
        raise LegsError(f"{words!r}: {error}") from None


def _has_default(field: Any) -> bool:
    return field.default is not field.default_factory  # both are MISSING where there is none


def _is(value: Any, kind: str) -> bool:
    if kind in ("int", "float"):
        is_number = isinstance(value, (int, float) if kind == "float" else int) and not isinstance(value, bool)
        return is_number and 0 < value < float("inf")
    if kind == "str":
        return isinstance(value, str)
    if kind.startswith("Mapping"):
        return isinstance(value, dict) and all(isinstance(one, str) for one in value.values())
    each = str if "str" in kind else dict
    return isinstance(value, list) and all(isinstance(one, each) for one in value)


def _read(path: Path) -> Dict[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        return tomllib.loads(read_regular(path, _LARGEST).decode("utf-8"))
    except OSError as error:
        raise LegsError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:  # all that a parser of TOML says, and of numbers and texts in it
        raise LegsError(f"{path} cannot be read: {error}") from None
