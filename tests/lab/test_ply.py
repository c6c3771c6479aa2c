"""The .ply: round trip, an independent reader and writer, and every kind of damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from legs_loss.errors import LegsError
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import read_ply, write_ply
from legs_loss.lab.training.adam import FIELDS


def some(count: int, degree: int) -> Gaussians:
    k = (degree + 1) ** 2
    shapes = ((count, 3), (count, 3), (count, 4), (count, 1), (count, k, 3))
    return Gaussians(*(torch.randn(shape) for shape in shapes))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
def test_a_round_trip_keeps_every_bit(tmp_path: Path, count: int, degree: int) -> None:
    gaussians = some(count, degree)
    write_ply(tmp_path / "new" / "a.ply", gaussians)
    again = read_ply(tmp_path / "new" / "a.ply")
    for name in FIELDS:
        assert torch.equal(getattr(again, name), getattr(gaussians, name)), name
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.ply"]


def test_the_header_and_one_row_by_hand(tmp_path: Path) -> None:
    gaussian = Gaussians(
        means=torch.tensor([[1.0, 2.0, 3.0]]),
        log_scales=torch.tensor([[30.0, 31.0, 32.0]]),
        quaternions=torch.tensor([[40.0, 41.0, 42.0, 43.0]]),
        opacity_logits=torch.tensor([[20.0]]),
        sh=torch.tensor([[[4.0, 5.0, 6.0], [10.0, 13.0, 16.0], [11.0, 14.0, 17.0], [12.0, 15.0, 18.0]]]),
    )
    write_ply(tmp_path / "a.ply", gaussian)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert lines[3:-1] == [f"property float {name}" for name in names]
    # f_rest: all coefficients of red, then of green, then of blue
    expected = [1, 2, 3, 0, 0, 0, 4, 5, 6, *range(10, 19), 20, 30, 31, 32, 40, 41, 42, 43]
    assert np.frombuffer(body, "<f4").tolist() == expected


def test_plyfile_reads_it_and_its_files_are_read(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    gaussians = some(5, 2)
    write_ply(tmp_path / "a.ply", gaussians)
    data = plyfile.PlyData.read(str(tmp_path / "a.ply"))
    vertex = data["vertex"]
    np.testing.assert_array_equal(vertex["y"], gaussians.means[:, 1])
    np.testing.assert_array_equal(vertex["rot_3"], gaussians.quaternions[:, 3])
    # As 3DGS's loader takes the rest apart: [N, 3, K - 1]
    rest = np.stack([vertex[f"f_rest_{i}"] for i in range(24)], axis=1).reshape(5, 3, 8)
    np.testing.assert_array_equal(rest.transpose(0, 2, 1), gaussians.sh[:, 1:])

    shuffled = data["vertex"].data[sorted(vertex.data.dtype.names, reverse=True)]
    columns = np.zeros(5, [(name, "<f4") for name in shuffled.dtype.names])
    for name in shuffled.dtype.names:
        columns[name] = shuffled[name]
    plyfile.PlyData([plyfile.PlyElement.describe(columns, "vertex")], byte_order="<").write(str(tmp_path / "b.ply"))
    again = read_ply(tmp_path / "b.ply")
    for name in FIELDS:
        assert torch.equal(getattr(again, name), getattr(gaussians, name)), name


def test_it_is_the_very_file_that_3dgs_writes(tmp_path: Path) -> None:
    """3DGS hands its attributes, in its order, to plyfile: these columns of zeros stand for its normals."""
    plyfile = pytest.importorskip("plyfile")
    gaussians = some(5, 3)
    means, sh = gaussians.means.numpy(), gaussians.sh.transpose(1, 2)
    columns = [means, np.zeros_like(means), sh[..., :1].flatten(1), sh[..., 1:].flatten(1), gaussians.opacity_logits]
    columns += [gaussians.log_scales, gaussians.quaternions]
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.empty(5, [(name, "f4") for name in names])
    rows[:] = [tuple(row) for row in np.concatenate(columns, 1)]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "theirs.ply"))
    write_ply(tmp_path / "ours.ply", gaussians)
    assert (tmp_path / "theirs.ply").read_bytes() == (tmp_path / "ours.ply").read_bytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_other_programs_files_by_plyfile(tmp_path: Path, order: str) -> None:
    """Without normals as gsplat's exporter and SuperSplat, with mip-splatting's filter, 8-bit colours, a float64."""
    plyfile = pytest.importorskip("plyfile")
    gaussians = some(5, 1)
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(9)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    sh = gaussians.sh.transpose(1, 2)
    columns = [gaussians.means, sh[..., 0], sh[..., 1:].flatten(1), gaussians.opacity_logits]
    columns += [gaussians.log_scales, gaussians.quaternions]
    values = torch.cat(columns, 1).numpy()
    types = [("red", "u1"), *((name, "f8" if name == "z" else "f4") for name in names), ("filter_3D", "f4")]
    rows = np.zeros(5, types)
    rows["red"], rows["filter_3D"] = 200, 0.25
    for i, name in enumerate(names):
        rows[name] = values[:, i]
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], byte_order=order, comments=["end_header is near"]).write(str(tmp_path / "a.ply"))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    (tmp_path / "crlf.ply").write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    for file in ("a.ply", "crlf.ply"):
        again = read_ply(tmp_path / file)
        for name in FIELDS:
            assert torch.equal(getattr(again, name), getattr(gaussians, name)), name


def test_damage_and_foreign_files_are_refused(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", some(3, 1))
    good = (tmp_path / "a.ply").read_bytes()
    damaged = {
        "not a binary .ply": b"",
        "a text; save it as a binary": good.replace(b"binary_little_endian", b"ascii"),
        "not a binary": b"\x89PNG" + good,
        "cut off or damaged": good[:-1],
        "or damaged": good + b"\0",
        "the header says 4": good.replace(b"vertex 3", b"vertex 4"),
        "property opacity is missing": good.replace(b"property float opacity", b"property float opaqueness"),
        "property scale_2 is missing": good.replace(b"property float scale_2\n", b""),
        "8 properties f_rest_* are not": good.replace(b"property float f_rest_8\n", b"property float other\n"),
        "header line 'property float y'": good.replace(b"property float x\n", b"property float y\n"),
        "the header says 3": good.replace(b"property float nx\n", b""),
        "cannot read the header line": good.replace(b"property float x\n", b"property list uchar int x\n"),
        "header line 'element vertex -3'": good.replace(b"vertex 3", b"vertex -3"),
        "has no `element vertex`": b"ply\nformat binary_little_endian 1.0\nend_header\n",
    }
    for message, data in damaged.items():
        (tmp_path / "b.ply").write_bytes(data)
        with pytest.raises(LegsError, match=r"b\.ply") as caught:
            read_ply(tmp_path / "b.ply")
        assert message in str(caught.value), (message, str(caught.value))
    with pytest.raises(LegsError, match="cannot be read"):
        read_ply(tmp_path / "none.ply")
    for length in range(0, len(good), 7):  # cut off anywhere
        (tmp_path / "b.ply").write_bytes(good[:length])
        with pytest.raises(LegsError):
            read_ply(tmp_path / "b.ply")
