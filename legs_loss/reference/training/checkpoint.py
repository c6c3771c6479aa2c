"""The state of a training on disk, as plain arrays: nothing is ever unpickled."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any, Dict, Mapping, Tuple

import numpy as np

from legs_loss.errors import LegsError

__all__ = ["read_checkpoint", "write_checkpoint"]


def write_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write arrays, and facts that JSON can hold. A checkpoint that was there is replaced as a whole, or not at all."""
    part = path.with_name(path.name + ".part")
    with open(str(part), "wb") as file:
        all_arrays: Dict[str, Any] = dict(arrays, __facts__=np.frombuffer(json.dumps(dict(facts)).encode(), np.uint8))
        np.savez(file, **all_arrays)
        file.flush()
        os.fsync(file.fileno())
    os.replace(str(part), str(path))


def read_checkpoint(path: Path) -> Tuple[Dict[str, np.ndarray], Dict[str, Any]]:
    """Return what :func:`write_checkpoint` wrote.

    Raises:
        LegsError: there is none, or the file is damaged.
    """
    try:
        with np.load(str(path), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return arrays, json.loads(arrays.pop("__facts__").tobytes().decode())
    except FileNotFoundError:
        raise LegsError(f"{path}: there is no such checkpoint") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise LegsError(f"{path}: this checkpoint is damaged ({error}): delete it and train anew") from None
