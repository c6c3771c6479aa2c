"""The settings of Inria's rasterizer; forks add their own."""

from __future__ import annotations

from collections import namedtuple
from typing import Any, Sequence

__all__ = ["SETTINGS", "settings_type"]

# Of a view, as Inria's renderer describes it; the matrices are transposed: points are rows.
SETTINGS = (
    "image_height",
    "image_width",
    "tanfovx",
    "tanfovy",
    "bg",  # [3]
    "scale_modifier",
    "viewmatrix",  # [4, 4]
    "projmatrix",  # [4, 4]: view and projection
    "sh_degree",
    "campos",  # [3]
    "prefiltered",
    "debug",
)


def settings_type(module: str, fields: Sequence[str] = SETTINGS, optional: bool = False) -> Any:
    """Return a module's ``GaussianRasterizationSettings`` with these fields; ``optional``: each is None by default.

    >>> settings_type("diff_foo", (*SETTINGS, "gamma"))._fields[-2:]
    ('debug', 'gamma')
    """
    return namedtuple(
        "GaussianRasterizationSettings", fields, defaults=(None,) * (len(fields) * optional), module=module
    )
