"""The settings of a run of another codebase: legs.toml, the environment, the script's arguments.

Later ones take precedence: the preset "legs", then legs.toml, then LEGS_* variables, then :func:`legs_loss.configure`.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple

from legs_loss.errors import LegsError, did_you_mean
from legs_loss.spec import PRESETS, WeightSpec, as_spec

CONFIG_FILE = "legs.toml"
STORE_FOLDER = "legs_weights"

# The keys of legs.toml, and in capitals the variables LEGS_*. The preset is the first: the others change it.
_SETTINGS = ("preset", "store", *(field.name for field in fields(WeightSpec)))
_TEXT_FIELDS = ("operator", "curve", "normalise", "over")
_OTHER_VARIABLES = ("off", "backend", "masks")
_JOURNAL = ".legs-patch.json"  # beside the legs.toml that legs-patch wrote
_LAMBDA = ": the share of D-SSIM is the codebase's own setting, in 3DGS --lambda_dssim"
_LARGEST = 1 << 20  # bytes of a legs.toml
_TRUE, _FALSE = ("1", "true", "yes", "on"), ("", "0", "false", "no", "off")


@dataclass(frozen=True)
class Config:
    """The settings of a run.

    Attributes:
        spec: the weight map's settings.
        preset: the name of the preset that the spec is derived from, for the status line.
        store: the folder of precomputed maps, or None.
        off: whether LEGS_OFF selects the codebase's own loss, unweighted.
        require_masks: whether LEGS_MASKS=require makes a training image without an entry in the store an error.
        source: where the settings were found, in words.
        notes: warnings for the user: an unknown variable LEGS_*, a legs.toml that was not read.
    """

    spec: WeightSpec = PRESETS["legs"]
    preset: str = "legs"
    store: Optional[Path] = None
    off: bool = False
    require_masks: bool = False
    source: str = "defaults"
    notes: Tuple[str, ...] = ()


def find_config(
    start: Optional[Path] = None, environ: Optional[Mapping[str, str]] = None, argv: Optional[List[str]] = None
) -> Config:
    """Return the settings of this run.

    Args:
        start: a file or folder of the codebase: legs.toml is looked for there and in the folders above it, up to the
            root of its git checkout (or of the codebase around it that legs-patch patched with it), the user's home
            folder, or the first legs.toml of another owner, which is not read. None: no file is searched.
        environ: in place of ``os.environ``: LEGS_PRESET, LEGS_BETA, LEGS_CURVE, LEGS_OPERATOR, LEGS_P,
            LEGS_PERCENTILE, LEGS_NORMALISE, LEGS_EPS, LEGS_OVER, LEGS_NOISE_FLOOR, LEGS_SMOOTH, LEGS_STORE, LEGS_OFF,
            LEGS_MASKS.
        argv: in place of ``sys.argv``: the scene after ``-s`` / ``--source_path`` is where the store is looked for.

    Raises:
        LegsError: a value is unknown or out of range, or the file cannot be read; the message has the place.
    """
    environ = os.environ if environ is None else environ
    config, notes = Config(), _unknown_variables(environ)
    if start is not None:
        path = _find_file(start.resolve())
        if path is not None and _is_foreign(path, start):
            notes += (f"{path} belongs to another user: it is not read",)
        elif path is not None:
            config = _apply(config, _read_toml(path), str(path), path.parent)
    given = {name: "LEGS_" + name.upper() for name in _SETTINGS if environ.get("LEGS_" + name.upper())}
    if given:  # all at once: some settings are valid only together
        what = f"environment variable{'s' if len(given) > 1 else ''} {', '.join(given.values())}"
        config = _apply(config, {name: environ[variable] for name, variable in given.items()}, what, Path.cwd())
    off, masks = is_off(environ), environ.get("LEGS_MASKS", "")
    if masks not in ("", "require"):
        raise LegsError(f"environment variable LEGS_MASKS must be require, or not set, got {masks!r}")
    store = config.store or _store_of_scene(sys.argv if argv is None else argv)
    return replace(config, store=store, off=off, require_masks=masks == "require", notes=notes)


def is_off(environ: Optional[Mapping[str, str]] = None) -> bool:
    """Return whether LEGS_OFF selects the codebase's own loss, bit-identical.

    Args:
        environ: in place of ``os.environ``.

    Raises:
        LegsError: it is neither 1 nor 0 nor a synonym of these.
    """
    value = (os.environ if environ is None else environ).get("LEGS_OFF", "")
    word = value.strip().lower()
    if word not in _TRUE + _FALSE:
        raise LegsError(f"environment variable LEGS_OFF must be 1 or 0 (true, yes, on; false, no, off), got {value!r}")
    return word in _TRUE


def _apply(config: Config, settings: Dict[str, Any], where: str, base: Path) -> Config:
    settings = dict(settings)
    try:
        for key in settings:
            if key not in _SETTINGS:
                raise LegsError(f"unknown setting {key!r}; there are {', '.join(_SETTINGS)}{_meant(key, _SETTINGS)}")
        preset = settings.pop("preset", None)
        store = store_folder(settings.pop("store", None), base)
        spec = config.spec if preset is None else as_spec(preset)
        spec = replace(spec, **{key: _typed(key, value) for key, value in settings.items()})
    except LegsError as error:
        raise LegsError(f"{where}: {error}") from None
    return replace(
        config,
        spec=spec,
        preset=config.preset if preset is None else preset,
        store=config.store if store is None else store,
        source=where if config.source == Config.source else f"{config.source}, {where}",
    )


def _typed(key: str, value: Any) -> Any:
    """Return a setting's value as WeightSpec takes it, which says what is wrong with any other."""
    with suppress(TypeError, ValueError, OverflowError):
        return value if key in _TEXT_FIELDS or isinstance(value, bool) else float(value)
    return value


def store_folder(value: Any, base: Path) -> Optional[Path]:
    """Return the folder that a setting names, relative to another folder; None without one.

    Raises:
        LegsError: it is no path.
    """
    if not isinstance(value, (str, Path, type(None))) or "\0" in str(value):
        raise LegsError(f"store must be a path, got {repr(value)[:100]}")
    try:
        return base / Path(value).expanduser() if value else None
    except RuntimeError:
        raise LegsError(f"store must be a path, got {repr(value)[:100]}, and there is no such user") from None


def _unknown_variables(environ: Mapping[str, str]) -> Tuple[str, ...]:
    known = [name.upper() for name in (*_SETTINGS, *_OTHER_VARIABLES)]
    return tuple(
        f"environment variable LEGS_{name} is not known and has no effect{_meant(name, known, 'LEGS_')}"
        for name in sorted(variable[len("LEGS_") :] for variable in environ if variable.startswith("LEGS_"))
        if name not in known and not name.startswith("TEST")
    )


def _meant(name: str, known: Sequence[str], prefix: str = "") -> str:
    """Return the end of a message on an unknown setting."""
    if "lambda" in name.lower():
        return _LAMBDA
    return did_you_mean(name, known).replace("'", f"'{prefix}", 1)


def _find_file(start: Path) -> Optional[Path]:
    """Return the legs.toml of a script or folder."""
    home, is_above = Path(os.path.expanduser("~")), False
    for folder in [start, *start.parents] if os.path.isdir(str(start)) else start.parents:
        path = folder / CONFIG_FILE
        if os.path.isfile(str(path)) and (not is_above or os.path.isfile(str(folder / _JOURNAL))):
            return path
        is_above = is_above or os.path.exists(str(folder / ".git"))
        if folder == home:
            break
    return None


def _is_foreign(path: Path, start: Path) -> bool:
    """Return whether a file is neither this user's nor of the owner of a script or folder."""
    if os.name != "posix":
        return False
    owners = {os.getuid()}
    with suppress(OSError):
        owners.add(start.stat().st_uid)
    return path.stat().st_uid not in owners


def _read_toml(path: Path) -> Dict[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    from legs_loss.system.files import read_text

    try:
        return tomllib.loads(read_text(path, _LARGEST))
    except (OSError, ValueError, RecursionError) as error:  # a TOML parser raises the last two
        raise LegsError(f"{path} cannot be read: {getattr(error, 'strerror', error)}") from None


def _store_of_scene(argv: List[str]) -> Optional[Path]:
    for flag in ("-s", "--source_path"):
        for argument, following in zip(argv, [*argv[1:], None]):
            name, equals, value = argument.partition("=")
            scene = value if equals else following
            if name == flag and scene is not None:
                store = Path(scene) / STORE_FOLDER
                return store if os.path.isdir(str(store)) else None  # False, too, for what no file can be called
    return None
