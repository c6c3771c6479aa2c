"""Scenes and checkpoints from a stranger: a file, its damage, and the one line that is expected."""

from __future__ import annotations

import json
import os
import struct

import numpy as np
import pytest

from legs_loss.errors import LegsError
from legs_loss.reference.training.checkpoint import read_state, write_checkpoint
from legs_loss.scenes import read_scene
from tests.support import colmap_scene, legs, photograph, save

HUGE = struct.pack("<Q", 1 << 60)


def at(place, data):
    """Return a function that writes these bytes over a file's, from this place on."""
    return lambda old: old[:place] + data + old[place + len(data) :]


IDENTITY = np.eye(4).tolist()
COLMAP = [
    ("images.bin", at(0, HUGE), "images.bin is damaged"),
    ("images.bin", at(12, struct.pack("<d", 1e300)), "the pose of"),
    ("images.bin", at(12, struct.pack("<4d", 0, 0, 0, 0)), "the pose of"),
    ("images.bin", at(44, struct.pack("<d", float("nan"))), "the pose of"),
    ("cameras.bin", at(0, HUGE), "cameras.bin is damaged"),
    ("cameras.bin", at(16, HUGE), "a camera of 1152921504606846976x"),
    ("cameras.bin", at(32, struct.pack("<d", float("inf"))), "with parameters"),
    ("points3D.bin", at(0, HUGE), "points3D.bin is damaged"),
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
    (frames(transform_matrix=[[1e308] * 4] * 4), "damaged"),
    (frames(transform_matrix=[[0.0] * 4] * 4), "damaged"),
    (frames(transform_matrix=[[1.0, 2.0]]), "no 4x4 matrix"),
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
    done = legs("precompute", root)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "Permission denied" in done.stderr


def state(**changes):
    """A checkpoint's arrays and facts, of five Gaussians, with these changed; None takes one away."""
    import torch

    sizes = {"means": (5, 3), "log_scales": (5, 3), "quaternions": (5, 4), "opacity_logits": (5, 1), "sh": (5, 4, 3)}
    arrays = {f"{label}.{name}": np.zeros(size, np.float32) for label in ("gaussians", "moment1", "moment2")
              for name, size in sizes.items()}  # fmt: skip
    arrays.update(gradient_sum=np.zeros(5), times_seen=np.zeros(5), steps=np.array(3))
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
    facts.update(weight_sum=0.0, growth=[], history=[])
    for name, value in changes.items():
        place = facts if name in facts else arrays
        place.pop(name) if value is None else place.update({name: value})
    return arrays, facts


CHECKPOINTS = [
    ({"gaussians.means": np.zeros((4, 3), np.float32)}, "gaussians.means is float32 of shape"),
    ({"moment1.sh": np.zeros((5, 9, 3), np.float32)}, "moment1.sh is float32"),
    ({"gaussians.sh": np.zeros((5, 3), np.float32)}, "gaussians.sh is float32"),
    ({"gaussians.sh": np.full((5, 4, 3), "text")}, "gaussians.sh is <U4"),
    ({"steps": np.zeros(2)}, "steps is float64"),
    ({"times_seen": None}, "no times_seen"),
    ({"generator": np.zeros(5056, np.uint8)}, "damaged"),
    ({"iteration": -1}, "other numbers"),
    ({"iteration": "many"}, "iteration is 'many'"),
    ({"order": [7]}, "other numbers"),
    ({"clocks": ["now"]}, "its clocks are no numbers"),
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


def test_a_compressed_checkpoint_is_none(tmp_path):
    """A few kilobytes could become gigabytes; ours are never compressed."""
    np.savez_compressed(str(tmp_path / "c.npz"), **{**state()[0], "more": np.zeros(1 << 20)})
    with pytest.raises(LegsError, match=r"is damaged \(compressed"):
        read_state(tmp_path / "c.npz")
