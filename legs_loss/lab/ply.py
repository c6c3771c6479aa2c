"""The .ply of 3DGS: Gaussians before activation, one float32 a property, as its viewers and its forks read it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import List, Tuple, Union

import numpy as np
import torch

from legs_loss.errors import LegsError
from legs_loss.lab.gaussians import Gaussians
from legs_loss.system.files import read_regular, write_whole

_COUNT = re.compile("[0-9]{1,20}")
_END = re.compile(rb"^end_header\r?\n", re.MULTILINE)
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_ORDERS = {"format binary_little_endian 1.0": "<", "format binary_big_endian 1.0": ">"}
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
    """Read a .ply of 3D Gaussians as 3DGS, its forks and gsplat write it, or viewers save it.

    The properties may stand in any order and be any numbers; normals and what else is not needed are left out.

    Raises:
        LegsError: not a binary .ply of Gaussians, the message names the property that is missing; or its size is not
            what the header says.
    """
    try:
        data = read_regular(path, _LARGEST)
    except OSError as error:
        raise LegsError(f"{path}: cannot be read ({error.strerror})") from None
    end = _END.search(data)
    lines = data[: end.start() if end else 0].decode("ascii", errors="replace").splitlines()
    order = _ORDERS.get(" ".join(lines[1:2]))
    if lines[:1] != ["ply"] or order is None:
        what = "a text; save it as a binary" if lines[1:2] == ["format ascii 1.0"] else "not a binary"
        raise LegsError(f"{path}: {what} .ply")
    count, kind = _parse_header(path, lines[2:], order)
    names = kind.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    coefficients = {3 * (k - 1): k for k in (1, 4, 9, 16)}.get(rest, 0)
    needed = [name for name in _properties(coefficients or 1) if not name.startswith("n")]
    missing = [name for name in needed if name not in names]
    if missing or not coefficients:
        what = f"property {missing[0]} is missing" if missing else f"{rest} properties f_rest_* are not 0, 9, 24 or 45"
        raise LegsError(f"{path}: not a .ply of 3D Gaussians: {what} (a point cloud, or a compressed .ply?)")
    body = memoryview(data)[end.end() if end else 0 :]
    if len(body) != count * kind.itemsize:
        raise LegsError(
            f"{path}: cut off or damaged: the header says {count} of {kind.itemsize} bytes, {len(body)} follow"
        )
    table = np.frombuffer(body, kind)
    columns = np.empty((count, len(needed)), np.float32)
    for i, name in enumerate(needed):
        columns[:, i] = table[name]
    parts = torch.from_numpy(columns).split([3, 3, 3 * (coefficients - 1), 1, 3, 4], dim=1)
    means, dc, rests, logits, log_scales, quaternions = (part.contiguous() for part in parts)
    rests = rests.reshape(count, 3, coefficients - 1).transpose(1, 2)
    return Gaussians(means, log_scales, quaternions, logits, torch.cat([dc[:, None], rests], dim=1).contiguous())


def _parse_header(path: Union[str, Path], lines: List[str], order: str) -> Tuple[int, np.dtype]:
    """Return the number of Gaussians and the layout of one: of the header's only element, its vertices."""
    count, fields = -1, {}
    for line in lines:
        words = line.split()
        if words[:1] in (["comment"], ["obj_info"], []):
            continue
        if words[:2] == ["element", "vertex"] and len(words) == 3 and _COUNT.fullmatch(words[2]) and count < 0:
            count = int(words[2])
        elif (
            words[0] == "property" and len(words) == 3 and words[1] in _TYPES and words[2] not in fields and count >= 0
        ):
            fields[words[2]] = order + _TYPES[words[1]]
        else:
            raise LegsError(f"{path}: cannot read the header line {line[:80]!r} of a .ply of 3D Gaussians")
    if count < 0:
        raise LegsError(f"{path}: the header has no `element vertex`")
    return count, np.dtype(list(fields.items()))
