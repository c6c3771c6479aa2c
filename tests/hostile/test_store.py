"""Stores from a stranger: whatever the maps, the manifest or the names are, a training computes and goes on."""

from __future__ import annotations

import hashlib
import io
import os
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import legs_loss
from benchmarks import fuzz
from legs_loss.errors import LegsError
from legs_loss.precompute import precompute
from legs_loss.scenes import View, image_tensor, load_training_image, read_scene
from legs_loss.store import StoreWriter, WeightStore
from legs_loss.store.manifest import MANIFEST, manifest_bytes, read_manifest
from tests.support import legs, photograph, save

SIZE = 12, 9


@pytest.fixture
def scene(tmp_path):
    folder = tmp_path / "scene"
    for seed in range(2):
        save(folder / "images" / f"{seed}.png", photograph(*SIZE, seed))
    precompute(read_scene(folder))
    return folder


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def header(text):
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


GOOD = np.linspace(0, 1, SIZE[0] * SIZE[1]).reshape(SIZE[1], SIZE[0]).astype(np.float16)


def changed(value):
    values = GOOD.copy()
    values[3, 4] = value
    return npy(values)


MAPS = {
    "nan": changed(np.nan),
    "infinite": changed(np.inf),
    "minus infinite": changed(-np.inf),
    "over one": changed(1.001),
    "below zero": changed(-0.5),
    "transposed": npy(np.ascontiguousarray(GOOD.T)),
    "by columns": npy(np.asfortranarray(GOOD)),
    "a pixel less": npy(GOOD[1:]),
    "of one dimension": npy(GOOD.ravel()),
    "of floats": npy(GOOD.astype(np.float32)),
    "big endian": npy(GOOD.astype(">f2")),
    "of objects": npy(np.array([{}])),
    "of gigabytes": header(b"{'descr': '<f2', 'fortran_order': False, 'shape': (1099511627776, 4194304)}\n") + b"00",
    "deep": header(b"(" * 60_000),
    "an open bracket": header(b"{'descr': '<f2', 'fortran_order': False, 'shape': (9, 12\n"),
    "not python": header(b"\xff" * 100),
    "empty": b"",
    "a zip": b"PK\x03\x04" + b"\0" * 40,
}


def put(scene, data):
    """Give the first view this map, with the checksum and the size that it has."""
    store = scene / "legs_weights"
    entries = read_manifest(store)
    entries[0] = replace(entries[0], bytes=max(1, len(data)), sha256=hashlib.sha256(data).hexdigest())
    (store / entries[0].file).write_bytes(data)
    (store / MANIFEST).write_bytes(manifest_bytes(entries))
    return entries[0]


def train(scene, view="0"):
    """The loss of a step on a view with the scene's store, and without a store."""
    photo = scene / "images" / f"{view}.png"
    target = image_tensor(load_training_image(View(photo.name, photo)))
    losses = []
    for store in (scene / "legs_weights", None):
        legs_loss.configure(store=store)
        losses.append(legs_loss.l1_loss(torch.full_like(target, 0.5).requires_grad_(), target, view=view).item())
    legs_loss.configure()
    return losses


@pytest.mark.parametrize("what", MAPS, ids=lambda what: what.replace(" ", "_"))
def test_a_map_that_is_no_response(what, scene, capsys):
    entry = put(scene, MAPS[what])
    stored, computed = train(scene)
    assert stored == computed
    assert entry.file in capsys.readouterr().err
    assert [damaged.view for damaged in WeightStore(scene / "legs_weights").check()[0]] == [entry.view]
    assert precompute(read_scene(scene)).made == [entry.view]
    assert WeightStore(scene / "legs_weights").check()[0] == []


def test_legs_info_says_so(scene):
    entry = put(scene, MAPS["nan"])
    done = legs("info", scene)
    assert done.returncode == 1
    assert "damaged    1" in done.stdout
    assert entry.file in done.stdout
    assert "Traceback" not in done.stderr


def test_a_map_of_terabytes_is_not_read(scene, capsys):
    """Its entry says so, too: memory for it would end the training, or the machine."""
    store = scene / "legs_weights"
    entries = read_manifest(store)
    entries[0] = replace(entries[0], bytes=1 << 40)
    try:
        with open(str(store / entries[0].file), "wb") as file:
            file.truncate(1 << 40)
    except OSError:
        pytest.skip("a file system without sparse files")
    (store / MANIFEST).write_bytes(manifest_bytes(entries))
    stored, computed = train(scene)
    assert stored == computed
    assert "no file of its kind has more" in capsys.readouterr().err
    assert len(WeightStore(store).check()[0]) == 1


MANIFESTS = {
    "empty": b"",
    "deep": b"[" * 200_000,
    "a number": b"1",
    "a version of text": b'{"version": "x", "entries": []}',
    "halves of letters": b'{"version": 1, "entries": ["\\ud800"]}',
    "huge numbers": b'{"version": ' + b"9" * 10_000 + b"}",
    "not utf-8": b"\xff\xfe{}",
}
FIELDS = [
    ("file", "../../outside-0123456789abcdef.npy"),
    ("file", "a-0123456789abcdef.npy\n"),
    ("file", 7),
    ("width", -1),
    ("width", 12.0),
    ("width", True),
    ("height", 1 << 70),
    ("bytes", -5),
    ("bytes", "many"),
    ("view", ""),
    ("view", "a\0b"),
    ("view", ["a"]),
    ("operator", {}),
    ("eps", float("inf")),
    ("p", -2.0),
    ("sha256", "Z" * 64),
    ("background", "red"),
    ("low", 1e300),
    ("span", float("inf")),
    ("median", -1.0),
    ("strong", 1e7),
]


def is_one_error(scene, capsys):
    before = _maps(scene)
    stored, computed = train(scene)
    assert stored == computed
    assert MANIFEST in capsys.readouterr().err
    with pytest.raises(LegsError, match=r"manifest\.json (is damaged: delete that file|cannot be read)"):
        precompute(read_scene(scene))
    with pytest.raises(LegsError, match=MANIFEST):
        WeightStore(scene / "legs_weights")
    assert _maps(scene) == before


def _maps(scene):
    """Every file of the store but its lock."""
    return {path.name: path.read_bytes() for path in (scene / "legs_weights").iterdir() if path.name != ".lock"}


@pytest.mark.parametrize("what", MANIFESTS, ids=lambda what: what.replace(" ", "_"))
def test_a_manifest_that_is_none(what, scene, capsys):
    (scene / "legs_weights" / MANIFEST).write_bytes(MANIFESTS[what])
    is_one_error(scene, capsys)


@pytest.mark.parametrize(("field", "value"), FIELDS)
def test_a_manifest_in_good_form_of_bad_entries(field, value, scene, capsys):
    entries = read_manifest(scene / "legs_weights")
    entries[0] = replace(entries[0], **{field: value})
    try:
        data = manifest_bytes(entries)
    except (TypeError, ValueError):  # it cannot even be written so
        data = (scene / "legs_weights" / MANIFEST).read_bytes().replace(b'"bytes"', b'"byte"')
    (scene / "legs_weights" / MANIFEST).write_bytes(data)
    is_one_error(scene, capsys)


@pytest.mark.parametrize("value", [b"9" * 400, b"1e999", b"NaN"], ids=["400 digits", "1e999", "NaN"])
@pytest.mark.parametrize("field", [b'"p": ', b'"source_mtime_ns": '])
def test_a_number_of_a_manifest_that_nothing_holds(field, value, scene, capsys):
    path = scene / "legs_weights" / MANIFEST
    path.write_bytes(fuzz.with_checksum(re.sub(field + rb"[^,}\n]+", field + value, path.read_bytes())))
    is_one_error(scene, capsys)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in this file system")
@pytest.mark.parametrize("what", ["map", "manifest", "lock"])
def test_a_pipe_hangs_nothing(what, scene):
    store = scene / "legs_weights"
    path = store / {"map": read_manifest(store)[0].file, "manifest": MANIFEST, "lock": ".lock"}[what]
    path.unlink()
    os.mkfifo(str(path))
    stored, computed = train(scene)
    assert stored == pytest.approx(computed, rel=1e-3)
    if what == "map":
        assert len(WeightStore(store).check()[0]) == 1
        assert len(precompute(read_scene(scene)).made) == 1
    else:
        with pytest.raises(LegsError, match="not a regular file but a pipe"):
            precompute(read_scene(scene))


@pytest.mark.parametrize("what", ["lock", "staging", "staging's lock", "map", "store"])
def test_precompute_writes_through_no_link(what, scene, tmp_path):
    store, outside = scene / "legs_weights", tmp_path / "outside"
    outside.mkdir()
    (outside / "precious.npy").write_bytes(b"mine")
    entry = read_manifest(store)[0]
    if what == "lock":
        (store / ".lock").unlink()
        (store / ".lock").symlink_to(outside / "made")
    elif what == "staging":
        (store / ".writing-theirs").symlink_to(outside)
    elif what == "staging's lock":
        (store / ".writing-theirs").mkdir()
        (store / ".writing-theirs" / ".lock").symlink_to(outside / "made")
    elif what == "map":
        (store / entry.file).unlink()
        (store / entry.file).symlink_to(outside / "precious.npy")
    else:
        for path in store.iterdir():
            path.unlink()
        store.rmdir()
        store.symlink_to(outside)
    if what in ("lock", "store"):
        with pytest.raises(LegsError, match=r"link|Too many levels"):
            precompute(read_scene(scene))
    else:
        precompute(read_scene(scene))
        assert legs("precompute", scene, "--workers", 1).returncode == 0
    if what == "store":
        assert legs("precompute", scene, "--workers", 1).returncode == 2
    assert os.listdir(str(outside)) == ["precious.npy"]
    assert (outside / "precious.npy").read_bytes() == b"mine"


def test_a_link_that_the_user_names_is_followed(scene, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    with StoreWriter(tmp_path / "link"):
        pass
    precompute(read_scene(scene), tmp_path / "link")
    assert len(WeightStore(tmp_path / "disk").entries) == 2
