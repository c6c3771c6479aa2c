"""Find a store's photographs, by a note beside the maps for a store outside of its scene's folder.

The note is only a hint: its readers compare fingerprints before they use a photograph as a map's source.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Optional

from legs_loss.errors import LegsError
from legs_loss.scenes import Scene, from_anywhere, read_scene
from legs_loss.system.files import read_regular, write_whole

NOTE = "scene.json"
_LIMIT = 1 << 16  # bytes


def note_scene(store: Path, scene: Scene) -> None:
    """Write the note of a store that was made from a scene; the newest scene stays.

    Raises:
        LegsError: the note cannot be written.
    """
    note = {"scene": os.path.abspath(str(scene.root)), "images": from_anywhere(scene.root, scene.images)}
    write_whole(store / NOTE, f"{json.dumps(note, indent=1)}\n".encode())


def scene_of_store(store: Path) -> Optional[Scene]:
    """Return the scene of a store: the one in its note, else the folder that contains it; None without one.

    Args:
        store: the store's folder.
    """
    root, images = store.resolve().parent, None
    with suppress(OSError, ValueError, TypeError, LookupError):  # none, or damaged
        note = json.loads(read_regular(store / NOTE, _LIMIT))
        root, images = Path(note["scene"]), None if note["images"] is None else str(note["images"])
    with suppress(LegsError):
        return read_scene(root, images)
    return None
