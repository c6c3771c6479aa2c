"""The response of a large photograph, by the compiled functions of the numba backend."""

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.numba_response import Images, operator_of, response_row
from legs_loss.spec import WeightSpec


def photograph_response(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return the response of a photograph uint8 or uint16 [H, W, C], scaled to [0, 1], as float32 [H, W]."""
    height, width, channels = image.shape
    out = np.empty((height, width), np.float32)
    rows = max(1, (1 << 18) // (width * channels))  # their floats stay in the cache
    full = np.float32(np.iinfo(image.dtype).max)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(top - 1, 0), min(bottom + 1, height)
        planes = image[first:last].transpose(2, 0, 1).astype(np.float32, order="C")
        planes /= full
        images = Images(planes.reshape(-1), planes.reshape(-1), 1, channels, last - first, width)
        _rows_of(images, operator_of(spec), top - first, out[top:bottom])
    return out


@compiled(fastmath=False)
def _rows_of(images, operator, first, out):  # type: ignore[no-untyped-def]
    for i in range(out.shape[0]):
        response_row(images, operator, np.int64(0), first + i, np.int64(0), images.width, out[i])
