"""The legs.toml that a patched checkout gets: the settings given on the command line, the others as comments."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, Mapping

from legs_loss import OPERATORS, PRESETS, LegsError
from legs_loss.spec import as_spec

SETTINGS_FILE = "legs.toml"
_HEAD = """\
# The LEGS loss of this codebase, written by legs-patch. Training scripts find this file by themselves.
# Environment variables outweigh it: LEGS_PRESET, LEGS_BETA, LEGS_CURVE, LEGS_OPERATOR, LEGS_STORE;
# LEGS_OFF=1 turns the loss back into the codebase's own.

"""
_COMMENTS = {
    "preset": f"one of {', '.join(PRESETS)}",
    "beta": "weight of the strongest response, minus 1; 0 is the plain L1",
    "curve": "C1 (linear) to C5",
    "operator": f"one of {', '.join(OPERATORS)}",
    "store": "what legs precompute wrote; a scene's own legs_weights/ is found without it",
}


def settings_text(root: Path, given: Mapping[str, Any]) -> str:
    """Return the text of legs.toml.

    Args:
        root: the checkout.
        given: by name (preset, beta, curve, operator, store) the settings that the user gave.

    Raises:
        LegsError: a setting is unknown or out of range, or the store's path is no text.
    """
    name = given.get("preset") or "legs"
    spec = replace(as_spec(name), **{key: given[key] for key in ("beta", "curve", "operator") if key in given})
    store = "path/to/legs_weights"
    if "store" in given:
        full = Path(os.path.abspath(os.path.expanduser(given["store"])))
        store = (full.relative_to(root) if root in (full, *full.parents) else full).as_posix()
        if store != store.encode("utf-8", "ignore").decode():
            raise LegsError(f"--store {given['store']}: its name is not in UTF-8, as legs.toml is: rename the folder")
    values = {"preset": name, "beta": spec.beta, "curve": spec.curve, "operator": spec.operator, "store": store}
    lines = [
        f"{'' if key in given or key == 'preset' else '# '}{key} = {_toml(value)}  # {_COMMENTS[key]}\n"
        for key, value in values.items()
    ]
    return _HEAD + "".join(lines)


def _toml(value: Any) -> str:
    """Return a value as TOML: JSON, but characters as they are, since JSON's surrogate pairs are none of TOML."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
