"""The state of a training on disk, as plain arrays without pickled objects, in a folder of its own."""

from __future__ import annotations

import json
import os
import platform
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, Mapping, Optional, Tuple

import numpy as np
import torch

from legs_loss.errors import LegsError
from legs_loss.lab.values import each, is_pair, is_scores, optional, with_names
from legs_loss.system.files import open_regular, write_whole
from legs_loss.system.locks import FileLock, HeldError
from legs_loss.system.values import is_count, is_number, is_text

CHECKPOINT = "checkpoint.npz"
LOCK = ".lock"  # in a run's folder, held while it is trained
WAIT = 10.0  # seconds for the lock: the processes of a comparison that was killed end a little later than it


def write_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> None:
    """Write arrays, and facts that JSON can hold. A checkpoint that was there is replaced as a whole, or not at all."""
    all_arrays: Dict[str, Any] = dict(arrays, __facts__=np.frombuffer(json.dumps(dict(facts)).encode(), np.uint8))
    write_whole(path, lambda file: np.savez(file, **all_arrays))


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write values to a JSON file, atomically; folders are made."""
    write_whole(path, (json.dumps(values, indent=1) + "\n").encode(), folders=True)


def read_checkpoint(path: Path) -> Tuple[Dict[str, np.ndarray], Dict[str, Any]]:
    """Return what :func:`write_checkpoint` wrote.

    Raises:
        LegsError: it is missing or damaged.
    """
    try:
        with open_regular(path) as raw, np.load(raw, allow_pickle=False) as file:
            if any(member.compress_type for member in file.zip.infolist()):
                raise ValueError("it is compressed, and no checkpoint is: it could be of any size")
            arrays = {name: file[name] for name in file.files}
        facts = json.loads(arrays.pop("__facts__").tobytes().decode())
    except FileNotFoundError:
        raise LegsError(f"{path}: there is no such checkpoint") from None
    except PermissionError as error:
        raise LegsError(f"{path}: cannot be read ({error.strerror})") from None
    except Exception as error:  # numpy, zipfile and zlib raise nearly anything on a damaged file
        why = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise LegsError(f"{path}: this checkpoint is damaged ({why}): delete it and train anew") from None
    return arrays, facts


def read_state(path: Path) -> Tuple[Dict[str, np.ndarray], Dict[str, Any]]:
    """Read a checkpoint to resume a training: its arrays and its facts, complete and of one size.

    Raises:
        LegsError: it is missing, or it is not a training's state.
    """
    arrays, facts = read_checkpoint(path)
    wrong = _what_is_wrong(arrays, facts)
    if wrong is not None:
        raise LegsError(f"{path}: this checkpoint is damaged ({wrong}): delete it and train anew")
    return arrays, facts


# What a checkpoint has to hold, and as what; the shapes of arrays with "n" Gaussians of "k" coefficients.
FACTS: Dict[str, Callable[[Any], bool]] = {
    "config": lambda value: type(value) is dict,
    "views": each(is_text),
    "iteration": is_count,
    "clocks": lambda value: each(is_number)(value) and len(value) == 2,
    "order": each(is_count),
    "loss": optional(is_number),
    "psnr": optional(is_number),
    "growth": each(is_pair),
    "history": each(with_names(is_scores, "iteration")),
}
_MOST = 1e15  # of any value: a step from there is a number still
_GAUSSIANS: Dict[str, Tuple[Any, ...]] = {
    "means": ("n", 3),
    "log_scales": ("n", 3),
    "quaternions": ("n", 4),
    "opacity_logits": ("n", 1),
    "sh": ("n", "k", 3),
}


def _what_is_wrong(arrays: Mapping[str, np.ndarray], facts: Any) -> Optional[str]:
    """Return why a checkpoint is not a training's state; None where it is valid."""
    if not isinstance(facts, dict):
        return "its facts are missing"
    for name, fits in FACTS.items():
        if name not in facts or not fits(facts[name]):
            return f"no {name}" if name not in facts else f"{name} is {facts[name]!r:.40}"
    if any(index >= len(facts["views"]) for index in facts["order"]):
        return "its views have other numbers"
    sets = ("gaussians", "moment1", "moment2")
    shapes = {f"{label}.{name}": shape for label in sets for name, shape in _GAUSSIANS.items()}
    shapes.update(gradient_sum=("n",), times_seen=("n",), steps=(), generator=(len(torch.Generator().get_state()),))
    missing = sorted(set(shapes) - set(arrays))
    if missing:
        return f"no {missing[0]}"
    count, coefficients = (arrays["gaussians.sh"].shape + (0, 0))[:2]
    sizes = {"n": count, "k": coefficients}
    kinds = {"steps": np.dtype(np.int64), "generator": np.dtype(np.uint8)}
    for name, shape in shapes.items():
        array, kind = arrays[name], kinds.get(name, np.dtype(np.float32))
        if array.shape != tuple(sizes.get(side, side) for side in shape) or array.dtype != kind:
            return f"{name} is {array.dtype} of shape {list(array.shape)}"
        least = 0.0 if name.startswith("moment2.") else -_MOST
        if kind == np.float32 and not ((array >= least) & (array <= _MOST)).all():
            return f"{name} has impossible values"
    if not 0 <= int(arrays["steps"]) < 1 << 31:
        return f"{arrays['steps']} steps"
    if coefficients not in (1, 4, 9, 16):
        return f"gaussians.sh has {coefficients} coefficients"
    try:
        torch.Generator().set_state(torch.from_numpy(arrays["generator"]))
    except (RuntimeError, TypeError) as error:
        return str(error).splitlines()[0]
    return None


def check_new(folder: Path) -> None:
    """Check that a folder holds no run, finished or not.

    Raises:
        LegsError: it does.
    """
    if (folder / CHECKPOINT).exists():
        raise LegsError(f"{folder} already holds a run: resume it (--resume), or choose another folder (--out)")


@contextmanager
def alone_in(folder: Optional[Path], make: bool) -> Iterator[None]:
    """Hold a run's folder: two trainings in one would overwrite each other's checkpoints.

    Raises:
        LegsError: another training holds it, or it cannot be made.
    """
    if folder is None:
        yield
        return
    lock: Optional[FileLock] = None
    try:
        if make:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LegsError(f"cannot write {folder}: {error.strerror or error}") from None
    try:
        lock = FileLock(folder / LOCK, wait=WAIT, note=f"process {os.getpid()} on {platform.node()}", remove=True)
    except HeldError as error:
        raise LegsError(f"{folder}: another training writes there ({error}): choose another folder") from None
    except OSError:  # no folder, or no room: what is written next says so
        pass
    try:
        yield
    finally:
        if lock is not None:
            with suppress(OSError):
                lock.release()
