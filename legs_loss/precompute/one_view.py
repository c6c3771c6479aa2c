"""One view of a scene -> its map, staged for the store; left alone where the store has it already."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Dict, Optional

from legs_loss.errors import LegsError
from legs_loss.precompute.executors import Listener
from legs_loss.precompute.photograph import normalised_map_and_levels
from legs_loss.scenes import image_size, load_training_image, training_size
from legs_loss.spec import WeightSpec
from legs_loss.store import Entry, fingerprint, is_intact, sampled_fingerprint, stage


class UnwritableError(LegsError):
    """The store cannot be written: unlike a photograph's, an error that ends the run."""


def make(
    spec: WeightSpec, resolution: int, white_background: bool, store: Path, staging: Path, task: Any, _: Listener
) -> Optional[Entry]:
    """Make the map of a view, and return its staged entry; None where the store's map is up to date.

    Args:
        spec, resolution, white_background: as for :func:`~legs_loss.precompute.precompute`.
        store: the store's folder.
        staging: its writer's.
        task: the view, and what the store has of it.

    Raises:
        LegsError: the photograph cannot be used.
        UnwritableError: nor can the store.
    """
    view, entries = task
    try:
        source = os.stat(str(view.path))
        width, height = training_size(*image_size(view.path), resolution)
        wanted: Dict[str, Any] = {"view": view.name, "width": width, "height": height}
        wanted.update(operator=spec.operator, p=spec.p, eps=spec.eps, smooth=float(spec.smooth))
        wanted.update(source_bytes=source.st_size, source_mtime_ns=source.st_mtime_ns)
        wanted["background"] = ("white" if white_background else "black") if view.composited else None
        if spec.over == "scene":
            wanted["percentile"] = float(spec.percentile)
        known = [entry for entry in entries if entry.sample and wanted.items() <= vars(entry).items()]
        if any(is_intact(store, entry) for entry in known):
            return None
        image = load_training_image(view, resolution, white_background)
        made, levels = normalised_map_and_levels(image, spec)
        entry = Entry(fingerprint=fingerprint(image), sample=sampled_fingerprint(image), **wanted, **levels)
    except (OSError, MemoryError) as error:
        raise LegsError(f"{view.path}: {error or 'not enough memory'}") from None
    try:
        return stage(staging, entry, made)
    except OSError as error:  # a full disk, a missing folder: all later views would fail too
        raise UnwritableError(error.strerror or str(error)) from None
