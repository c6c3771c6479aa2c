"""The legs.toml that a patched checkout gets: the settings given on the command line, the others as comments."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Dict, List, Optional

from legs_loss import OPERATORS, PRESETS, LegsError
from legs_loss.errors import did_you_mean

__all__ = ["SETTINGS_FILE", "settings_text"]

SETTINGS_FILE = "legs.toml"


def settings_text(
    root: Path,
    preset: Optional[str] = None,
    beta: Optional[float] = None,
    curve: Optional[str] = None,
    operator: Optional[str] = None,
    store: Optional[str] = None,
) -> str:
    """Return the text of legs.toml.

    Raises:
        LegsError: a setting is unknown or out of range.
    """
    name = preset or "legs"
    if name not in PRESETS:
        raise LegsError(
            f"no preset is named {name!r}: choose one of {', '.join(PRESETS)}" + did_you_mean(name, PRESETS)
        )
    base = PRESETS[name]
    given: Dict[str, Any] = {"beta": beta, "curve": curve, "operator": operator}
    spec = replace(base, **{key: value for key, value in given.items() if value is not None})
    if store is not None:
        full = os.path.abspath(os.path.expanduser(store))
        store = Path(os.path.relpath(full, str(root))).as_posix() if _inside(full, root) else Path(full).as_posix()

    def line(key: str, value: object, active: bool, comment: str) -> str:
        return f"{'' if active else '# '}{key} = {json.dumps(value)}  # {comment}"

    lines: List[str] = [
        "# The LEGS loss of this codebase, written by legs-patch. Training scripts find this file by themselves.",
        "# Environment variables outweigh it: LEGS_PRESET, LEGS_BETA, LEGS_CURVE, LEGS_OPERATOR, LEGS_STORE;",
        "# LEGS_OFF=1 turns the loss back into the codebase's own.",
        "",
        line("preset", name, True, f"one of {', '.join(PRESETS)}"),
        line("beta", spec.beta, beta is not None, "weight of the strongest response, minus 1; 0 is the plain L1"),
        line("curve", spec.curve, curve is not None, "C1 (linear) to C5"),
        line("operator", spec.operator, operator is not None, f"one of {', '.join(OPERATORS)}"),
        line(
            "store",
            store if store is not None else "path/to/legs_weights",
            store is not None,
            "what legs precompute wrote; a scene's own legs_weights/ is found without it",
        ),
    ]
    return "\n".join(lines) + "\n"


def _inside(full: str, root: Path) -> bool:
    return full == str(root) or full.startswith(str(root).rstrip(os.sep) + os.sep)
