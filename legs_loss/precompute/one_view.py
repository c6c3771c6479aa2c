"""One view of a scene -> its map, staged for the store; left alone where the store has it already."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Dict, NamedTuple, Optional, Sequence

from legs_loss.errors import LegsError
from legs_loss.precompute.executors import Listener
from legs_loss.precompute.photograph import normalised_map_and_levels
from legs_loss.scenes import View, image_size, load_training_image, training_size
from legs_loss.spec import WeightSpec
from legs_loss.store import Entry, fingerprint, is_intact, sampled_fingerprint, stage


class Job(NamedTuple):
    """The settings that all views of a run share."""

    spec: WeightSpec
    resolution: int
    white_background: bool
    store: Path
    staging: Path


class ViewTask(NamedTuple):
    """A view to be made."""

    view: View
    known: Sequence[Entry]  # what the store has of this view


class UnwritableError(LegsError):
    """The store cannot be written: unlike a photograph's, an error that ends the run."""


def make(job: Job, task: ViewTask, _: Listener) -> Optional[Entry]:
    """Make the map of a view, and return its staged entry; None where the store's map is up to date.

    Raises:
        LegsError: the photograph cannot be used.
        UnwritableError: nor can the store.
    """
    view = task.view
    try:
        source = os.stat(str(view.path))
        width, height = training_size(*image_size(view.path), job.resolution)
        wanted: Dict[str, Any] = {
            "view": view.name,
            "width": width,
            "height": height,
            "operator": job.spec.operator,
            "p": job.spec.p,
            "eps": job.spec.eps,
            "smooth": float(job.spec.smooth),
            **({"percentile": float(job.spec.percentile)} if job.spec.over == "scene" else {}),
            "background": ("white" if job.white_background else "black") if view.composited else None,
            "source_bytes": source.st_size,
            "source_mtime_ns": source.st_mtime_ns,
        }
        known = [entry for entry in task.known if entry.sample and wanted.items() <= vars(entry).items()]
        if any(is_intact(job.store, entry) for entry in known):
            return None
        image = load_training_image(view, job.resolution, job.white_background)
        made, levels = normalised_map_and_levels(image, job.spec)
        entry = Entry(fingerprint=fingerprint(image), sample=sampled_fingerprint(image), **wanted, **levels)
    except (OSError, MemoryError) as error:
        raise LegsError(f"{view.path}: {error or 'not enough memory'}") from None
    try:
        return stage(job.staging, entry, made)
    except OSError as error:  # a full disk, a missing folder: all later views would fail too
        raise UnwritableError(error.strerror or str(error)) from None
