"""The settings of a training run whose code is not ours: a legs.toml, the environment, the script's own arguments.

Later ones win: the preset "legs", then legs.toml, then LEGS_* variables, then :func:`legs_loss.configure`.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Dict, List, Mapping, Optional

from legs_loss.errors import LegsError
from legs_loss.spec import PRESETS, WeightSpec, as_spec

__all__ = ["CONFIG_FILE", "STORE_FOLDER", "Config", "find_config"]

CONFIG_FILE = "legs.toml"
STORE_FOLDER = "legs_weights"

_SPEC_FIELDS = {field.name: field for field in fields(WeightSpec)}
_TEXT_FIELDS = ("operator", "curve", "normalise")


@dataclass(frozen=True)
class Config:
    """What a run uses.

    Attributes:
        spec: the weight map's settings.
        preset: the name that the spec started from, for the line that says what is active.
        store: the folder of precomputed maps, or None.
        off: the codebase's own loss, unweighted.
        source: where the settings were found, in words.
    """

    spec: WeightSpec = PRESETS["legs"]
    preset: str = "legs"
    store: Optional[Path] = None
    off: bool = False
    source: str = "defaults"

    @property
    def active(self) -> bool:
        """Whether any weight is applied."""
        return not self.off and not self.spec.unweighted


def find_config(
    start: Optional[Path] = None,
    environ: Optional[Mapping[str, str]] = None,
    argv: Optional[List[str]] = None,
) -> Config:
    """Return the settings of this run.

    Args:
        start: a file or folder of the codebase: legs.toml is looked for there and in the folders above it, up to the
            root of its git checkout. None looks nowhere.
        environ: in place of ``os.environ``: LEGS_PRESET, LEGS_BETA, LEGS_CURVE, LEGS_OPERATOR, LEGS_P,
            LEGS_PERCENTILE, LEGS_NORMALISE, LEGS_SCALE, LEGS_EPS, LEGS_ERROR, LEGS_ERROR_BLUR, LEGS_STORE, LEGS_OFF.
        argv: in place of ``sys.argv``: the scene after ``-s`` / ``--source_path`` is where the store is looked for.

    Raises:
        LegsError: a value is unknown or out of range, or the file cannot be read; the message says where it stands.
    """
    environ = os.environ if environ is None else environ
    config = Config()
    path = _find_file(start) if start is not None else None
    if path is not None:
        config = _apply(config, _read_toml(path), str(path), path.parent)
    config = _apply(config, _from_environment(environ), "environment variable LEGS_*", Path.cwd())
    if environ.get("LEGS_OFF", "0") not in ("", "0"):
        config = replace(config, off=True)
    if config.store is None:
        config = replace(config, store=_store_of_scene(sys.argv if argv is None else argv))
    return config


def _apply(config: Config, settings: Dict[str, Any], where: str, base: Path) -> Config:
    if not settings:
        return config
    settings = dict(settings)
    try:
        preset = settings.pop("preset", None)
        store = settings.pop("store", None)
        unknown = [key for key in settings if key not in _SPEC_FIELDS]
        if unknown:
            raise LegsError(f"unknown setting {unknown[0]!r}; there are preset, store, {', '.join(_SPEC_FIELDS)}")
        spec = config.spec if preset is None else as_spec(preset)
        spec = replace(spec, **{key: _typed(key, value) for key, value in settings.items()})
    except LegsError as error:
        raise LegsError(f"{where}: {error}") from None
    return replace(
        config,
        spec=spec,
        preset=config.preset if preset is None else preset,
        store=config.store if not store else (base / Path(str(store)).expanduser()),
        source=where,
    )


def _typed(key: str, value: Any) -> Any:
    if key in _TEXT_FIELDS:
        return str(value)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise LegsError(f"{key} must be a number, got {value!r}") from None


def _from_environment(environ: Mapping[str, str]) -> Dict[str, Any]:
    names = ["preset", "store", *_SPEC_FIELDS]
    return {name: environ["LEGS_" + name.upper()] for name in names if environ.get("LEGS_" + name.upper())}


def _find_file(start: Path) -> Optional[Path]:
    start = start.resolve()
    for folder in [start, *start.parents] if start.is_dir() else start.parents:
        if (folder / CONFIG_FILE).is_file():
            return folder / CONFIG_FILE
        if (folder / ".git").exists():
            return None
    return None


def _read_toml(path: Path) -> Dict[str, Any]:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise LegsError(f"{path} cannot be read: {error}") from None


def _store_of_scene(argv: List[str]) -> Optional[Path]:
    for flag in ("-s", "--source_path"):
        for i, argument in enumerate(argv):
            if argument == flag and i + 1 < len(argv):
                scene = argv[i + 1]
            elif argument.startswith(flag + "="):
                scene = argument[len(flag) + 1 :]
            else:
                continue
            store = Path(scene) / STORE_FOLDER
            return store if store.is_dir() else None
    return None
