"""Find views whose photograph is out of focus, moved or noisy compared with its scene, from their maps.

A normalised response E^ is relative to an image's weakest and strongest response. In a sharp photograph few pixels are
near the strongest; blur lowers the strongest, noise raises all others, and either raises the mean of E^. So the views
with the largest mean weight are reported here.

Maps that are normalised over their scene (``legs precompute --preset legs-robust``) have more data: a photograph that
moved or is out of focus has weaker contours than the others, a noisy one a larger median. This also finds motion, which
lowers all responses of a photograph alike.
"""

from __future__ import annotations

import math
from statistics import median
from typing import Dict, List, Mapping

import numpy as np

from legs_loss.store import Entry, WeightStore

LEAST = 5  # views: fewer have no outliers
DEVIATIONS = 4.0  # of a normal distribution, from the median
FACTOR = 1.5  # and at least this multiple of the median: nearly equal views have no outliers


def outliers(means: Mapping[str, float]) -> List[str]:
    """Return the names whose mean response is far above the others', the farthest first.

    >>> outliers({"a": 0.05, "b": 0.052, "c": 0.048, "d": 0.051, "e": 0.049, "blurred": 0.15})
    ['blurred']
    """
    logs = {name: math.log(max(mean, 1e-6)) for name, mean in means.items()}
    if len(logs) < LEAST:
        return []
    middle = median(logs.values())
    spread = 1.4826 * median(abs(value - middle) for value in logs.values())
    limit = middle + max(DEVIATIONS * spread, math.log(FACTOR))
    return sorted((name for name, value in logs.items() if value > limit), key=lambda name: -logs[name])


def unsharp_views(store: WeightStore) -> List[str]:
    """Return the views of a store whose photographs seem out of focus, moved or noisy.

    Raises:
        LegsError: a map cannot be read.
    """
    entries = _alike(store)
    if any(entry.strong is None or entry.median is None for entry in entries):
        means = {entry.view: float(store.normalised_response(entry).mean(dtype=np.float64)) for entry in entries}
        return outliers(means)
    weak = outliers({entry.view: 1.0 / max(entry.strong or 0.0, 1e-6) for entry in entries})
    noisy = outliers({entry.view: entry.median or 0.0 for entry in entries})
    return list(dict.fromkeys(weak + noisy))


def _alike(store: WeightStore) -> List[Entry]:
    """Return the entries of the response and size that most views have; of several, of those with levels."""
    groups: Dict[object, List[Entry]] = {}
    for entry in (entry for entry in store.entries.values() if not entry.is_users):
        key = entry.operator, entry.p, entry.smooth, entry.percentile, entry.width * entry.height
        groups.setdefault(key, []).append(entry)
    return max(groups.values(), key=lambda entries: (len(entries), entries[0].strong is not None), default=[])
