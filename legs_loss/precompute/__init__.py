"""Scene -> store: the normalised response of every photograph, made once for every later training.

Views are shared out to processes, each with one photograph in memory at a time; the response is computed in strips of
rows. What is finished is in the store within about a second, so a run that is interrupted or killed goes on where it
was. A view is up to date, and left alone, while its photograph's file has the size and time of change that were
recorded, its map's checksum holds, and size, operator and background are those asked for.
"""

from __future__ import annotations

from legs_loss.precompute.one_scene import Report, precompute
from legs_loss.precompute.photograph import normalised_map, response_map

__all__ = ["Report", "normalised_map", "precompute", "response_map"]
