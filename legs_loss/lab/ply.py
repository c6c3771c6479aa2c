"""The .ply of 3DGS: Gaussians before activation, one float32 a property, as its viewers and its forks read it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import List, Tuple, Union

import numpy as np
import torch

from legs_loss.errors import LegsError
from legs_loss.lab.gaussians import Gaussians
from legs_loss.system import read_regular, write_whole

__all__ = ["read_ply", "write_ply"]

_COUNT = re.compile("[0-9]{1,20}")
_LARGEST = 64 << 30  # bytes: some 270 million Gaussians


def _properties(coefficients: int) -> List[str]:
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"f_dc_{i}" for i in range(3)]
    names += [f"f_rest_{i}" for i in range(3 * (coefficients - 1))]
    return names + ["opacity"] + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]


def write_ply(path: Union[str, Path], gaussians: Gaussians) -> None:
    """Write Gaussians as a binary little-endian .ply; folders are made, an older file is replaced as a whole.

    The file holds logarithms of scales, logits of opacities, quaternions wxyz, and for the spherical harmonics above
    degree 0 all coefficients of red, then green, then blue, as 3DGS does.
    """
    g = gaussians
    count, coefficients = g.sh.shape[:2]
    rest = g.sh[:, 1:].transpose(1, 2).reshape(count, 3 * (coefficients - 1))
    columns = [g.means, torch.zeros(count, 3), g.sh[:, 0], rest, g.opacity_logits, g.log_scales, g.quaternions]
    table = torch.cat([column.detach().float().cpu() for column in columns], dim=1).numpy().astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [f"property float {name}" for name in _properties(coefficients)] + ["end_header", ""]
    write_whole(path, "\n".join(header).encode("ascii") + table.tobytes(), folders=True)


def read_ply(path: Union[str, Path]) -> Gaussians:
    """Read a .ply that 3DGS or :func:`write_ply` wrote; the properties may stand in any order.

    Raises:
        LegsError: not a binary little-endian .ply of Gaussians, or its size is not what the header says.
    """
    try:
        data = read_regular(path, _LARGEST)
    except OSError as error:
        raise LegsError(f"{path}: cannot be read ({error.strerror})") from None
    head, end, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").splitlines()
    if not end or lines[:2] != ["ply", "format binary_little_endian 1.0"]:
        raise LegsError(f"{path}: not a binary little-endian .ply")
    count, names = _parse_header(path, lines[2:])
    kind = {len(_properties((degree + 1) ** 2)): (degree + 1) ** 2 for degree in range(4)}
    coefficients = kind.get(len(names), 0)
    if sorted(names) != sorted(_properties(coefficients or 1)):
        raise LegsError(
            f"{path}: not a .ply of 3D Gaussians: its properties must be those of 3DGS (x, y, z, nx, ny, nz, f_dc_*, "
            "f_rest_*, opacity, scale_*, rot_*)"
        )
    if len(body) != 4 * count * len(names):
        raise LegsError(
            f"{path}: the header says {count} Gaussians of {4 * len(names)} bytes, but {len(body)} bytes follow: "
            "the file is cut off or damaged"
        )
    table = torch.from_numpy(np.frombuffer(body, "<f4").reshape(count, len(names)).astype(np.float32))
    order = [names.index(name) for name in _properties(coefficients)]
    sizes = [3, 3, 3, 3 * (coefficients - 1), 1, 3, 4]
    means, _, dc, rest, logits, log_scales, quaternions = (
        part.contiguous() for part in table[:, order].split(sizes, dim=1)
    )
    rest = rest.reshape(count, 3, coefficients - 1).transpose(1, 2)
    return Gaussians(means, log_scales, quaternions, logits, torch.cat([dc[:, None], rest], dim=1).contiguous())


def _parse_header(path: Union[str, Path], lines: List[str]) -> Tuple[int, List[str]]:
    count, names = -1, []
    for line in lines:
        words = line.split()
        if words[:1] in (["comment"], ["obj_info"], []):
            continue
        if words[:2] == ["element", "vertex"] and len(words) == 3 and _COUNT.fullmatch(words[2]) and count < 0:
            count = int(words[2])
        elif words[0] == "property" and len(words) == 3 and words[1] in ("float", "float32") and count >= 0:
            names.append(words[2])
        else:
            raise LegsError(f"{path}: cannot read the header line {line[:80]!r} of a .ply of 3D Gaussians")
    if count < 0:
        raise LegsError(f"{path}: the header has no `element vertex`")
    return count, names
