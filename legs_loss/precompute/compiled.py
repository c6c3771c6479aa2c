"""The response of a large photograph, by the compiled functions of the numba backend."""

from __future__ import annotations

import numpy as np

from legs_loss.kernels.compiling import compiled
from legs_loss.kernels.numba_response import Images, operator_of, response_row
from legs_loss.scenes.images import image_tensor, row_strips
from legs_loss.spec import WeightSpec


def photograph_response(image: np.ndarray, spec: WeightSpec) -> np.ndarray:
    """Return the response of a photograph uint8 or uint16 [H, W, C], scaled to [0, 1], as float32 [H, W]."""
    height, width, channels = image.shape
    out = np.empty((height, width), np.float32)
    for rows in row_strips(height, width):  # their floats stay in the cache
        first, last = max(rows.start - 1, 0), min(rows.stop + 1, height)
        planes = image_tensor(image[first:last]).numpy().reshape(-1)
        images = Images(planes, planes, 1, channels, last - first, width)
        _rows_of(images, operator_of(spec), rows.start - first, out[rows])
    return out


@compiled(fastmath=False)
def _rows_of(images, operator, first, out):  # type: ignore[no-untyped-def]
    for i in range(out.shape[0]):
        response_row(images, operator, np.int64(0), first + i, np.int64(0), images.width, out[i])
