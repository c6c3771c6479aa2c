"""Scenes, photographs and checkpoints from a stranger: a file, its damage, and the one line that is expected."""

from __future__ import annotations

import json
import os
import struct
import time

import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from legs_loss.cli import main
from legs_loss.errors import LegsError
from legs_loss.lab.training.checkpoint import read_state, write_checkpoint
from legs_loss.scenes import View, image_size, load_training_image, read_scene
from tests.support import colmap_scene, legs, legs_environment, photograph, save

HUGE = struct.pack("<Q", 1 << 60)


def at(place, data):
    """Return a function that writes these bytes over a file's, from this place on."""
    return lambda old: old[:place] + data + old[place + len(data) :]


IDENTITY = np.eye(4).tolist()
COLMAP = [
    ("images.bin", at(0, HUGE), "images.bin is not as COLMAP writes it"),
    ("images.bin", at(12, struct.pack("<d", 1e300)), "the pose of"),
    ("images.bin", at(12, struct.pack("<4d", 0, 0, 0, 0)), "the pose of"),
    ("images.bin", at(44, struct.pack("<d", float("nan"))), "the pose of"),
    ("images.bin", at(72, b"../../a"), "leads out of the scene"),
    ("images.bin", at(72, b"/a"), "leads out of the scene"),
    ("images.bin", at(72, b"a" * 9000), "a name does not end"),
    ("cameras.bin", at(0, HUGE), "cameras.bin is not as COLMAP writes it"),
    ("cameras.bin", at(16, HUGE), "a camera of 1152921504606846976x"),
    ("cameras.bin", at(32, struct.pack("<d", float("inf"))), "with parameters"),
    ("cameras.bin", at(32, struct.pack("<d", 0)), "with parameters"),
    ("cameras.bin", at(32, struct.pack("<d", -50)), "with parameters"),
    ("cameras.bin", at(40, struct.pack("<d", 0)), "with parameters"),
    ("cameras.bin", at(40, struct.pack("<d", float("nan"))), "with parameters"),
    ("cameras.bin", at(48, struct.pack("<d", 1e300)), "with parameters"),
    ("cameras.bin", at(16, struct.pack("<Q", 0)), "a camera of 0x30"),
    ("cameras.bin", at(24, struct.pack("<Q", 1 << 63)), "a camera of 40x9223372036854775808"),
    ("cameras.bin", at(12, struct.pack("<i", 99)), "has model 99"),
    ("cameras.bin", at(12, struct.pack("<i", -1)), "has model -1"),
    ("cameras.bin", at(8, struct.pack("<i", 7)), "has camera 1, which cameras.bin does not list"),
    ("cameras.bin", lambda old: old[:-3], "cameras.bin is not as COLMAP writes it"),
    ("images.bin", at(44, struct.pack("<d", 1e300)), "the pose of"),
    ("images.bin", at(68, struct.pack("<i", 5)), "has camera 5, which cameras.bin does not list"),
    ("images.bin", at(72, b"a/../../b"), "leads out of the scene"),
    ("images.bin", at(72, b"..\\b"), "leads out of the scene"),
    ("images.bin", at(72, b"\0"), "no file can have"),
    ("images.bin", at(72, b"\xff\xfe"), "images.bin is not as COLMAP writes it"),
    ("points3D.bin", at(0, HUGE), "points3D.bin is not as COLMAP writes it"),
    ("points3D.bin", at(0, struct.pack("<Q", 0)), "where its own counts say 8"),
    ("points3D.bin", at(16, struct.pack("<d", float("nan"))), "a point is nowhere"),
    ("points3D.bin", at(24, struct.pack("<d", float("-inf"))), "a point is nowhere"),
    ("points3D.bin", lambda old: old[:-1], "points3D.bin is not as COLMAP writes it"),
    ("points3D.bin", lambda old: b"", "points3D.bin is not as COLMAP writes it"),
    ("points3D.bin", at(16, struct.pack("<d", 1e300)), "a point is nowhere"),
    ("points3D.bin", at(51, HUGE), "too early"),
]


@pytest.mark.parametrize(("name", "change", "line"), COLMAP)
def test_colmap(name, change, line, tmp_path):
    root = colmap_scene(tmp_path / "scene")
    file = root / "sparse" / "0" / name
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(LegsError, match=line):
        _ = read_scene(root).points


TEXT = [
    ("cameras", "1 PINHOLE 40 30 0 51 20 15", "with parameters"),
    ("cameras", "1 PINHOLE 40 30 -50 51 20 15", "with parameters"),
    ("cameras", "1 PINHOLE 40 30 nan 51 20 15", "with parameters"),
    ("cameras", "1 PINHOLE 40 30 50 51 20", "has 4 parameters, not 3"),
    ("cameras", "1 SIMPLE_RADIAL 40 30 -50 20 15 0", "with parameters"),
    ("cameras", f"1 PINHOLE {'9' * 400} 30 50 51 20 15", "a camera of 999"),
    ("cameras", f"1 PINHOLE {'9' * 5000} 30 50 51 20 15", "cameras.txt is not as COLMAP writes it|a camera of 999"),
    ("cameras", "one", "cameras.txt is not as COLMAP writes it"),
    ("images", "1 1 0 0 0 0 0 0 1 ../../a.png", "leads out of the scene"),
    ("images", "1 1 0 0 0 0 0 0 1 /etc/passwd", "leads out of the scene"),
    ("images", "1 0 0 0 0 0 0 0 1 a.png", "the pose of"),
    ("images", "1 1 0 0 nan 0 0 0 1 a.png", "the pose of"),
    ("images", "1 1 0 0 0 0 0 0 1", "images.txt is not as COLMAP writes it"),
    ("points3D", "1 0 0 1e39 7 7 7 0", "a point is nowhere"),
    ("points3D", "1 0 0 0 256 7 7 0", "a point's colour"),
    ("points3D", "1 0 0", "points3D.txt is not as COLMAP writes it"),
]


@pytest.mark.parametrize(("name", "text", "line"), TEXT, ids=lambda value: str(value)[:40])
def test_colmap_s_texts(name, text, line, tmp_path):
    """One short error says what is wrong; mended, the scene is read."""
    save(tmp_path / "images" / "a.png", photograph(40, 30))
    good = {"cameras": "1 PINHOLE 40 30 50 51 20 15", "images": "1 1 0 0 0 0 0 0 1 a.png\n", "points3D": ""}
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for file, content in {**good, name: text}.items():
        (tmp_path / "sparse" / "0" / f"{file}.txt").write_text(content + "\n")
    with pytest.raises(LegsError, match=line) as raised:
        _ = read_scene(tmp_path).points
    assert len(str(raised.value)) < 1000
    (tmp_path / "sparse" / "0" / f"{name}.txt").write_text(good[name] + "\n")
    assert len(read_scene(tmp_path).views) == 1


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "cameras.txt"])
def test_a_file_of_nine_gigabytes_is_not_read(name, tmp_path):
    root = colmap_scene(tmp_path / "scene")
    if name.endswith(".txt"):
        for file in ("cameras", "images"):
            (root / "sparse" / "0" / f"{file}.bin").rename(root / "sparse" / "0" / f"{file}.txt")
    os.truncate(str(root / "sparse" / "0" / name), 9 << 30)  # a hole, which takes no room
    began = time.process_time()
    with pytest.raises(LegsError, match=r"where its own counts say|no file of its kind has more"):
        _ = read_scene(root).points
    assert time.process_time() - began < 5


def frames(**changes):
    frame = {"file_path": "images/0.png", "transform_matrix": IDENTITY, "w": 8, "h": 6, "fl_x": 9.0}
    return json.dumps({"frames": [{**frame, **changes}]})


TRANSFORMS = [
    ("", "damaged"),
    ("[" * 100_000, "damaged"),
    ("[]", "damaged"),
    ('{"frames": 7}', "damaged"),
    ('{"frames": {"a": 1}}', "damaged"),
    (frames(file_path="a\0b"), "no file can have"),
    (frames(file_path=""), "no file can have"),
    (frames(file_path=["a"]), "damaged"),
    (frames(w=0), "a camera of 0x6"),
    (frames(w=1e400), "damaged"),
    (frames(w=1 << 40), "a camera of 1099511627776x6"),
    (frames(fl_x=float("nan")), "focal lengths nan"),
    (frames(fl_x=0), "focal lengths 0"),
    (frames(fl_x=-9.0), "focal lengths -9"),
    (frames(cx=1e300), "a camera of 8x6"),
    (frames(transform_matrix=[[1e308] * 4] * 4), "damaged"),
    (frames(transform_matrix=[[0.0] * 4] * 4), "damaged"),
    (frames(transform_matrix=[[1.0, 2.0]]), "not a 4x4 matrix"),
    (frames(transform_matrix="x"), "damaged"),
    ('{"camera_angle_x": 0, "frames": [{"file_path": "images/0.png", "transform_matrix": 0}]}', "damaged"),
    ('{"camera_angle_x": Infinity, "frames": [{"file_path": "images/0.png", "transform_matrix": 0}]}', "damaged"),
]


@pytest.mark.parametrize(("text", "line"), TRANSFORMS)
def test_transforms(text, line, tmp_path):
    save(tmp_path / "images" / "0.png", photograph(8, 6))
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(LegsError, match=line) as raised:
        read_scene(tmp_path)
    assert str(tmp_path / "transforms.json") in str(raised.value)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root reads everything")
def test_mode_000(tmp_path):
    root = colmap_scene(tmp_path / "scene")
    (root / "sparse" / "0" / "images.bin").chmod(0)
    done = legs("precompute", root, "--workers", 1)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "Permission denied" in done.stderr


def state(**changes):
    """A checkpoint's arrays and facts, of five Gaussians, with these changed; None takes one away."""
    import torch

    sizes = {"means": (5, 3), "log_scales": (5, 3), "quaternions": (5, 4), "opacity_logits": (5, 1), "sh": (5, 4, 3)}
    arrays = {f"{label}.{name}": np.zeros(size, np.float32) for label in ("gaussians", "moment1", "moment2")
              for name, size in sizes.items()}  # fmt: skip
    arrays.update(gradient_sum=np.zeros(5, np.float32), times_seen=np.zeros(5, np.float32), steps=np.array(3))
    arrays["generator"] = torch.Generator().get_state().numpy()
    facts = {
        "config": {},
        "views": ["a"],
        "iteration": 3,
        "clocks": [0.0, 0.0],
        "order": [0],
        "loss": None,
        "psnr": None,
    }
    facts.update(growth=[], history=[])
    for name, value in changes.items():
        place = facts if name in facts else arrays
        place.pop(name) if value is None else place.update({name: value})
    return arrays, facts


CHECKPOINTS = [
    ({"gaussians.means": np.zeros((4, 3), np.float32)}, "gaussians.means is float32 of shape"),
    ({"moment1.sh": np.zeros((5, 9, 3), np.float32)}, "moment1.sh is float32"),
    ({"gaussians.sh": np.zeros((5, 3), np.float32)}, "gaussians.sh is float32"),
    ({"gaussians.sh": np.full((5, 4, 3), "text")}, "gaussians.sh is <U4"),
    ({"gaussians.means": np.zeros((5, 3), np.int64)}, "gaussians.means is int64"),
    ({"gaussians.means": np.zeros((5, 3))}, "gaussians.means is float64"),
    ({"gaussians.means": np.zeros((5, 3), ">f4")}, "gaussians.means is >f4"),
    ({"gaussians.means": np.full((5, 3), np.nan, np.float32)}, "gaussians.means has impossible values"),
    ({"moment1.sh": np.full((5, 4, 3), 3e38, np.float32)}, "moment1.sh has impossible values"),
    ({"moment2.sh": np.full((5, 4, 3), -1, np.float32)}, "moment2.sh has impossible values"),
    ({"steps": np.zeros(2)}, "steps is float64"),
    ({"steps": np.array(-1)}, "-1 steps"),
    ({"times_seen": None}, "no times_seen"),
    ({"generator": np.zeros(5056, np.uint8)}, "damaged"),
    ({"iteration": -1}, "iteration is -1"),
    ({"iteration": True}, "iteration is True"),
    ({"iteration": 10**30}, "iteration is 1000"),
    ({"loss": 10**400}, "loss is 1000"),
    ({"clocks": [0, 10**400]}, "clocks is"),
    ({"growth": [7]}, "growth is"),
    ({"iteration": "many"}, "iteration is 'many'"),
    ({"order": [7]}, "other numbers"),
    ({"clocks": ["now"]}, "clocks is"),
    ({"config": None}, "no config"),
]


@pytest.mark.parametrize(("changes", "line"), CHECKPOINTS)
def test_a_checkpoint_in_good_form(changes, line, tmp_path):
    path = tmp_path / "c.npz"
    write_checkpoint(path, *state())
    read_state(path)
    write_checkpoint(path, *state(**changes))
    with pytest.raises(LegsError, match=line):
        read_state(path)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["train", "--seed", 10**30], "seed must be an integer of 64 bits"),
        (["train", "--iterations", 10**400], "iterations must be"),
        (["train", "-r", 10**400], "resolution must be"),
        (["precompute", "-r", 10**30], "resolution must be"),
        (["compare", "--seeds", 10**12], "--seeds must be at most 1000"),
    ],
    ids=str,
)
def test_a_number_that_nothing_holds(words, line, tmp_path, tiny_scene, capsys):
    pytest.importorskip("numba")
    command, *options = map(str, words)
    assert main([command, str(tiny_scene), *options, "--out", str(tmp_path / "out")]) == 2
    errors = [text for text in capsys.readouterr().err.splitlines() if "error:" in text]
    assert len(errors) == 1
    assert line in errors[0]


def test_a_compressed_checkpoint_is_none(tmp_path):
    """A few kilobytes could become gigabytes; ours are never compressed."""
    np.savez_compressed(str(tmp_path / "c.npz"), **{**state()[0], "more": np.zeros(1 << 20)})
    with pytest.raises(LegsError, match=r"is damaged \(it is compressed"):
        read_state(tmp_path / "c.npz")


# Only pictures are decoded, in this process, and only from regular files.
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n(%pipe%id) (r) file\nshowpage\n%%EOF\n"


@pytest.fixture
def ghostscript(tmp_path):
    """Put a ``gs`` first on a path; return that path and the file that it makes when it runs."""
    ran, program = tmp_path / "gs-ran", tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {ran}\necho 10.0\n")
    program.chmod(0o755)
    return os.pathsep.join([str(program.parent), os.environ["PATH"]]), ran


def test_an_eps_named_jpg_starts_nothing(tmp_path, ghostscript, monkeypatch):
    path, ran = ghostscript
    photo = tmp_path / "scene" / "photo.jpg"
    save(photo.with_name("real.jpg"), photograph(8, 8))
    photo.write_bytes(EPS)
    done = legs("precompute", photo.parent, "--workers", 1, env=dict(legs_environment(), PATH=path))
    assert done.returncode != 0
    assert f"{photo}: not an image in a format that is read here (JPEG, PNG," in done.stderr
    assert "Traceback" not in done.stderr
    assert not ran.exists()
    # What Pillow does by itself, or this test would prove nothing.
    monkeypatch.setenv("PATH", path)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None, raising=False)  # before Pillow 10 there is none
    with pytest.raises(OSError), Image.open(str(photo)) as image:
        image.load()
    assert ran.exists()


@pytest.mark.parametrize("suffix", ["eps", "ps", "pdf", "fits", "wmf", "xpm", "psd"])
def test_what_is_no_photograph_is_not_decoded(suffix, tmp_path):
    heads = {"pdf": b"%PDF-1.4\n", "fits": b"SIMPLE  =                    T", "psd": b"8BPS\0\1", "xpm": b"/* XPM */"}
    heads["wmf"] = b"\xd7\xcd\xc6\x9a\0\0"
    path = tmp_path / "photo.png"
    path.write_bytes(heads.get(suffix, EPS).ljust(4000, b" "))
    with pytest.raises(LegsError, match="not an image in a format that is read here"):
        image_size(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(str(tmp_path / "photo.jpg"))
    with pytest.raises(LegsError, match="not a regular file but a pipe"):
        load_training_image(View("photo.jpg", tmp_path / "photo.jpg"))


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif", "bmp", "ppm", "tga", "gif", "jp2"])
def test_photographs_are(suffix, tmp_path):
    assert image_size(save(tmp_path / f"photo.{suffix}", photograph(9, 7))) == (9, 7)
