"""Write COLMAP's sparse model in its binary format: https://colmap.github.io/format.html."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Dict, Mapping, Tuple

import numpy as np

from legs_loss.scenes.model import Camera, PointCloud
from legs_loss.system.files import write_whole


def write_colmap(root: Path, cameras: Mapping[str, Camera], points: PointCloud) -> None:
    """Write ``root/sparse/0`` in COLMAP's binary format (PINHOLE cameras, no tracks).

    ``cameras`` maps an image's name, relative to ``root/images``, to its camera.
    """
    folder = Path(root) / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    ids: Dict[Tuple[Any, ...], int] = {}
    posed = [struct.pack("<Q", len(cameras))]
    for number, (name, camera) in enumerate(sorted(cameras.items()), start=1):
        intrinsics = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        camera_id = ids.setdefault(intrinsics, len(ids) + 1)
        quaternion = _quaternion(camera.world_to_camera[:3, :3])
        pose = struct.pack("<i7d", number, *quaternion, *camera.world_to_camera[:3, 3])
        no_points = struct.pack("<Q", 0)
        posed.append(pose + struct.pack("<i", camera_id) + name.encode() + b"\0" + no_points)
    lenses = [struct.pack("<Q", len(ids))]
    lenses += [struct.pack("<iiQQ4d", number, 1, *lens) for lens, number in ids.items()]
    cloud = [struct.pack("<Q", len(points.xyz))]
    cloud += [
        struct.pack("<Q3d3BdQ", number, *xyz, *rgb, 0.0, 0)
        for number, (xyz, rgb) in enumerate(zip(points.xyz.tolist(), points.rgb.tolist()), start=1)
    ]
    for file, parts in (("images", posed), ("cameras", lenses), ("points3D", cloud)):
        write_whole(folder / f"{file}.bin", b"".join(parts))


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion w, x, y, z with w >= 0 of a rotation [3, 3]."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64)
    # Row k is 4 q_k q: the one with the largest diagonal is the safest to divide by.
    products = np.array(
        [
            [1 + a + e + i, h - f, c - g, d - b],
            [h - f, 1 + a - e - i, b + d, c + g],
            [c - g, b + d, 1 - a + e - i, f + h],
            [d - b, c + g, f + h, 1 - a - e + i],
        ]
    )
    row = products[np.argmax(np.diag(products))]
    return row / np.linalg.norm(row) * (1 if row[0] >= 0 else -1)
