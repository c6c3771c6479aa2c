"""A comparison's folder and a .ply from a stranger: a field, its value, and the one line expected."""

from __future__ import annotations

import json

import numpy as np
import pytest

from legs_loss.errors import LegsError
from legs_loss.lab.gaussians import Gaussians
from legs_loss.lab.ply import read_ply, write_ply

pytest.importorskip("numba")

from legs_loss.lab.experiments.running import read_rows

ROW = [
    (["seed"], "../../../x"),
    (["seed"], -1),
    (["seed"], True),
    (["seed"], 1 << 70),
    (["seed"], "<script>alert(1)</script>"),
    (["arm"], "../../x"),
    (["arm"], "legs\x1b[2J"),
    (["arm"], 7),
    (["config"], []),
    (["config", "iterations"], "12"),
    (["config", "iterations"], 0),
    (["config", "spec"], "legs"),
    (["config"], {"spec": "legs", "iterations": 12}),
    (["config", "seed"], [0]),
    (["config", "spec", "beta"], 1e300),
    (["config", "spec", "curve"], "C9"),
    (["config", "shuffled"], "os.system"),
    (["caps"], [[1]]),
    (["versions"], "1"),
    (["metrics"], None),
    (["metrics", "gaussians"], -1),
    (["metrics", "iterations"], 0),
    (["metrics", "train"], {}),
    (["metrics", "test", "psnr"], "20"),
    (["metrics", "test", "psnr"], 10**400),
    (["metrics", "test", "psnr"], 1e308),
    (["metrics", "views"], {"train": {}}),
    (["metrics", "growth"], [["a", 1]]),
    (["metrics", "history"], [{}]),
    (["upstream"], {"profile": "3dgs", "threshold_factor": 1.0, "pictures": {"a.png": 7}}),
    (["upstream"], {"profile": "3dgs", "threshold_factor": "1", "pictures": {}}),
    (["upstream"], []),
]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    from benchmarks.fuzz import make_comparison

    folder = tmp_path_factory.mktemp("compared")
    make_comparison(folder)
    return folder


@pytest.mark.parametrize(("place", "value"), ROW)
def test_a_row(place, value, compared):
    path = compared / "legs" / "seed-0" / "row.json"
    good = path.read_text()
    row = json.loads(good)
    inner = row
    for name in place[:-1]:
        inner = inner[name]
    inner[place[-1]] = value
    path.write_text(json.dumps(row))
    try:
        with pytest.raises(LegsError, match=rf"row.json: this file is damaged \({place[0]}\): delete it"):
            read_rows(compared)
    finally:
        path.write_text(good)
    assert len(read_rows(compared)[1]) == 1


@pytest.mark.parametrize("value", [[], {}, {"loss": 0.5}, {"views": 2, "loss": 10**400}, {"plain_calls": 10**400}])
def test_what_settings_say_of_the_baseline(value, compared):
    path = compared / "comparison.json"
    good = path.read_text()
    path.write_text(json.dumps(dict(json.loads(good), baseline=value)))
    try:
        with pytest.raises(LegsError, match=r"comparison.json: this file is damaged \(baseline\)"):
            read_rows(compared)
    finally:
        path.write_text(good)


@pytest.mark.parametrize("value", [{}, {"profile": "3dgs"}, {"extra": [7]}])
def test_what_settings_say_of_a_codebase(value, compared):
    path = compared / "comparison.json"
    good = path.read_text()
    path.write_text(json.dumps(dict(json.loads(good), upstream=value)))
    try:
        with pytest.raises(LegsError, match=r"comparison.json: this file is damaged \(upstream\)"):
            read_rows(compared)
    finally:
        path.write_text(good)


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"3", b"[" * 100_000, b"\xff\xfe", b"{}", b'{"arm": ' + b"9" * 5000 + b"}"]
)
@pytest.mark.parametrize("name", ["comparison.json", "legs/seed-0/row.json"])
def test_a_file_of_anything(name, data, compared):
    path = compared / name
    good = path.read_bytes()
    path.write_bytes(data)
    try:
        with pytest.raises(LegsError, match=r"this file is damaged"):
            read_rows(compared)
    finally:
        path.write_bytes(good)


@pytest.mark.parametrize("path", ["ABSOLUTE", "../../../secret.png", "link.png", "../../x/../../secret.png"])
def test_a_picture_from_outside_is_none(path, tmp_path):
    from types import SimpleNamespace

    from legs_loss.lab.report.html_pictures import _upstreams_own
    from tests.support import photograph, save

    row = tmp_path / "out" / "legs" / "seed-0"
    row.mkdir(parents=True)
    save(tmp_path / "secret.png", photograph(8, 6, 0))
    save(row / "mine.png", photograph(8, 6, 0))
    (row / "link.png").symlink_to(tmp_path / "secret.png")
    pictures = {"a.png": path.replace("ABSOLUTE", str(tmp_path / "secret.png")), "b.png": "../seed-0/mine.png"}
    values = {"arm": "legs", "upstream": {"pictures": pictures}}
    with pytest.raises(LegsError, match=r"left no rendering of a\.png"):
        _upstreams_own(values, row, SimpleNamespace(name="a.png"))
    assert _upstreams_own(values, row, SimpleNamespace(name="b.png")).shape == (3, 6, 8)


def header(*lines, count=1):
    return "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {count}", *lines, "end_header", ""])


PLY = {
    "nothing": (lambda good: b"", "not a binary .ply"),
    "text": (lambda good: good.replace(b"binary_little_endian", b"ascii"), "a text; save it as a binary"),
    "no end of the header": (lambda good: good.replace(b"end_header", b"end_headex"), "not a binary .ply"),
    "cut off": (lambda good: good[:-1], "cut off or damaged"),
    "longer": (lambda good: good + b"x", "cut off or damaged"),
    "2^60 of them": (lambda good: good.replace(b"vertex 9", b"vertex %d" % (1 << 60)), "cut off or damaged"),
    "a number of 5,000 digits": (lambda good: good.replace(b"vertex 9", b"vertex " + b"9" * 5000), "header"),
    "a number of another script": (lambda good: good.replace(b"vertex 9", "vertex ²".encode()), "header"),
    "less than none": (lambda good: good.replace(b"vertex 9", b"vertex -9"), "cannot read the header line"),
    "two elements": (
        lambda good: good.replace(b"vertex 9", b"vertex 9\nelement face 2"),
        "cannot read the header line",
    ),
    "a list": (lambda good: good.replace(b"float x", b"list uchar int x"), "cannot read the header line"),
    "doubles": (lambda good: good.replace(b"float x", b"double x"), "cut off or damaged"),
    "a name twice": (lambda good: good.replace(b"float y\n", b"float x\n"), "cannot read the header line"),
    "another name": (lambda good: good.replace(b"float x", b"float \x1b[2J"), "not a .ply of 3D Gaussians"),
    "no properties": (lambda good: header().encode(), "not a .ply of 3D Gaussians"),
    "a header of megabytes": (lambda good: good.replace(b"ply\n", b"ply\n" + b"a" * (8 << 20)), "not a binary"),
}


@pytest.mark.parametrize("what", PLY, ids=lambda what: what.replace(" ", "_"))
def test_ply(what, tmp_path):
    path = tmp_path / "g.ply"
    points = np.random.RandomState(0).rand(9, 3).astype(np.float32)
    write_ply(path, Gaussians.from_points(points, np.full((9, 3), 9, np.uint8), 1))
    change, line = PLY[what]
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(LegsError, match=line) as raised:
        read_ply(path)
    assert len(str(raised.value)) < 1000
    assert "\x1b" not in str(raised.value)
