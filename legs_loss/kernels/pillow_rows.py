"""The pixels of a Pillow image where they lie in memory, four bytes each of RGB: without a copy, where Pillow can.

Pillow 11.2 and later hand out an image that is in one piece by the C interface of Apache Arrow
(https://arrow.apache.org/docs/format/CDataInterface.html): a list of pixels, each a list of bytes.
"""

from __future__ import annotations

import ctypes
from typing import Any, Iterator, Optional, Tuple

import numpy as np

__all__ = ["BYTES", "strips"]

BYTES = 4  # of a pixel
_STRIP = 32  # rows that are copied at a time


class _Array(ctypes.Structure):
    """Arrow's struct ArrowArray, as far as it is read here."""


_Array._fields_ = [
    ("length", ctypes.c_int64),
    ("null_count", ctypes.c_int64),
    ("offset", ctypes.c_int64),
    ("n_buffers", ctypes.c_int64),
    ("n_children", ctypes.c_int64),
    ("buffers", ctypes.POINTER(ctypes.c_void_p)),
    ("children", ctypes.POINTER(ctypes.POINTER(_Array))),
]


def strips(image: Any) -> Iterator[Tuple[int, np.ndarray]]:
    """Yield the pixels of an RGB image in strips from the top: a strip's first row, and uint8 [rows * width * 4].

    A strip is there until the next one is asked for.
    """
    capsule = _capsule(image)
    pixels = None if capsule is None else _bytes_of(capsule, image.width * image.height)
    if pixels is not None:
        yield 0, pixels
        return
    for top in range(0, image.height, _STRIP):
        strip = image.crop((0, top, image.width, min(top + _STRIP, image.height)))
        yield top, np.frombuffer(strip.tobytes("raw", "RGBX"), np.uint8)


def _capsule(image: Any) -> Any:
    """What owns the memory that Pillow hands out; None where it hands out none."""
    try:
        return image.__arrow_c_array__()[1]
    except (AttributeError, ValueError):  # an older Pillow; an image in several pieces
        return None


def _bytes_of(capsule: Any, pixels: int) -> Optional[np.ndarray]:
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    whole = _Array.from_address(pointer(capsule, b"arrow_array"))
    if whole.length != pixels or whole.offset or whole.n_children != 1:
        return None
    values = whole.children[0].contents
    if values.length != pixels * BYTES or values.offset or values.n_buffers != 2:
        return None
    found = np.frombuffer((ctypes.c_uint8 * values.length).from_address(values.buffers[1]), np.uint8)
    found.flags.writeable = False
    return found
