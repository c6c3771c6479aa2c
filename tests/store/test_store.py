"""A store gives back the maps that were put in, notices any damage, and survives writers that die or meet."""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import multiprocessing
import os
import pickle
import signal
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import legs_loss.store as store_module
from legs_loss.errors import LegsError
from legs_loss.spec import WeightSpec
from legs_loss.store import (
    MANIFEST,
    DamagedStoreError,
    Entry,
    StoreWriter,
    WeightStore,
    fingerprint,
    maps,
    read_map,
    stage,
)
from legs_loss.store.manifest import VERSION, manifest_bytes

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

BLANK = Entry("images/a.png", 4, 3, "laplacian", 2.0, 1e-8, None, "f" * 32, 10, 20)


def ramp(entry, shift=0):
    return ((np.arange(entry.height * entry.width) + shift) / 1000).reshape(entry.height, entry.width)


def put(folder, *entries, shift=0):
    with StoreWriter(folder) as writer:
        writer.commit([stage(writer.staging, entry, ramp(entry, shift)) for entry in entries])


def views(*names):
    return [replace(BLANK, view=name) for name in names]


class TestRoundTrip:
    def test_values_and_settings(self, tmp_path):
        wide = replace(BLANK, view="images/b.png", width=7, operator="sobel", p=float("inf"), background="white")
        put(tmp_path / "s", BLANK, wide)
        store = WeightStore(tmp_path / "s")
        found = store.find("images/b.png", 3, 7, WeightSpec("sobel", float("inf")))
        assert replace(found, file="", bytes=0, sha256="") == wide
        normalised = store.normalised_response(found)
        assert normalised.dtype == np.float16
        assert np.array_equal(normalised, ramp(wide).astype(np.float16))
        assert torch.from_numpy(normalised).shape == (3, 7)

    @pytest.mark.parametrize(
        ("height", "width", "spec"),
        [(4, 3, WeightSpec()), (3, 5, WeightSpec()), (3, 4, WeightSpec("sobel")), (3, 4, WeightSpec(p=1.0))]
        + [(3, 4, WeightSpec(eps=1e-6))],
    )
    def test_another_size_or_operator_is_not_found(self, tmp_path, height, width, spec):
        put(tmp_path, BLANK)
        assert WeightStore(tmp_path).find("images/a.png", height, width, spec) is None

    def test_curve_and_beta_do_not_matter(self, tmp_path):
        put(tmp_path, BLANK)
        assert WeightStore(tmp_path).find("a", 3, 4, WeightSpec(curve="C5", beta=3.0, percentile=99.0))

    def test_a_new_map_replaces_the_old_one_and_its_file(self, tmp_path):
        put(tmp_path, *views("a.png", "b.png"))
        put(tmp_path, *views("a.png"), shift=5)
        store = WeightStore(tmp_path)
        assert np.array_equal(
            store.normalised_response(store.find("a", 3, 4, WeightSpec())), ramp(BLANK, 5).astype("f2")
        )
        assert len(list(tmp_path.glob("*.npy"))) == 2

    def test_opening_reads_the_manifest_only(self, tmp_path):
        put(tmp_path, BLANK)
        for file in tmp_path.glob("*.npy"):
            file.unlink()
        store = WeightStore(tmp_path)
        with pytest.raises(DamagedStoreError, match="cannot be read"):
            store.normalised_response(store.find("a", 3, 4, WeightSpec()))


class TestNames:
    @pytest.mark.parametrize(
        "name", ["images/cam 1/x.y.png", "images/cam 1/x.y", "cam 1/x.y.png", "x.y.png", "x.y", "x", "cam 1\\x.y.png"]
    )
    def test_every_way_to_ask(self, tmp_path, name):
        put(tmp_path, *views("images/cam 1/x.y.png", "images/other.png"))
        assert WeightStore(tmp_path).find(name, 3, 4, WeightSpec()).view == "images/cam 1/x.y.png"

    @pytest.mark.parametrize("name", ["y.png", "im", "", "images", "X", "images/x"])
    def test_what_is_no_name(self, tmp_path, name):
        put(tmp_path, *views("images/cam 1/x.y.png"))
        assert WeightStore(tmp_path).find(name, 3, 4, WeightSpec()) is None

    def test_an_ambiguous_name_is_never_guessed(self, tmp_path):
        put(tmp_path, *views("images/cam1/x.png", "images/cam2/x.png", "images/cam3/x.png", "x.a.jpg", "x.b.jpg"))
        store = WeightStore(tmp_path)
        for name in ("x", "x.png"):
            assert store.find(name, 3, 4, WeightSpec()) is None
        for name in ("cam1/x", "images/cam2/x.png", "x.b"):
            assert name in store.find(name, 3, 4, WeightSpec()).view

    def test_files_are_safe_and_distinct_on_any_file_system(self, tmp_path):
        names = [
            "a.png",
            "A.png",
            "a.jpg",
            "ä.png",
            "日本.png",
            "con.png",
            "../../up.png",
            "/abs/a.png",
            "a b/c:d?.png",
        ]
        names.append("x" * 300 + ".png")
        put(tmp_path / "s", *views(*names))
        store = WeightStore(tmp_path / "s")
        files = [entry.file for entry in store.entries.values()]
        assert len({file.lower() for file in files}) == len(names)
        assert all(len(file) < 80 and file.isascii() and "/" not in file for file in files)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["s"]
        assert store.check() == ([], [])
        assert {entry.view for entry in store.entries.values()} == set(names)


@pytest.mark.parametrize("shape", [(1, 1), (3, 4), (3361, 5000), (123456, 1048576)])
def test_a_map_begins_as_numpy_writes_it(tmp_path, shape):
    entry = replace(BLANK, height=shape[0], width=shape[1], view="a.png")
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f2", "fortran_order": False, "shape": shape})
    assert maps._head(entry) == file.getvalue()
    if shape[0] * shape[1] < 100:
        staged = stage(tmp_path, entry, ramp(entry))
        assert np.array_equal(np.load(tmp_path / staged.file), ramp(entry).astype("f2"))


class TestDamage:
    @pytest.mark.parametrize("mask", [0x01, 0x20, 0xFF])
    def test_every_byte_flipped_once_is_noticed(self, tmp_path, mask):
        put(tmp_path, *views("a.png", "b.png"))
        for path in [tmp_path / MANIFEST, *tmp_path.glob("*.npy")]:
            whole = path.read_bytes()
            for i in range(len(whole)):
                path.write_bytes(whole[:i] + bytes([whole[i] ^ mask]) + whole[i + 1 :])
                with pytest.raises(LegsError):
                    self.read_all(tmp_path)
            path.write_bytes(whole)
        assert self.read_all(tmp_path) == 2

    def test_cut_and_lengthened_files_are_noticed(self, tmp_path):
        put(tmp_path, BLANK)
        for path in [tmp_path / MANIFEST, *tmp_path.glob("*.npy")]:
            whole = path.read_bytes()
            for data in (b"", whole[:-1], whole + b"\n", whole * 2):
                path.write_bytes(data)
                with pytest.raises(DamagedStoreError, match="legs precompute again"):
                    self.read_all(tmp_path)
            path.write_bytes(whole)

    @staticmethod
    def read_all(folder):
        store = WeightStore(folder)
        return len([store.normalised_response(entry) for entry in store.entries.values()])

    def test_check_names_damaged_and_orphaned_files(self, tmp_path):
        put(tmp_path, *views("a.png", "b.png", "c.png"))
        store = WeightStore(tmp_path)
        a, b, _ = sorted(store.entries.values(), key=lambda entry: entry.view)
        (tmp_path / a.file).write_bytes(b"")
        (tmp_path / b.file).unlink()
        (tmp_path / "orphan-0123456789abcdef.npy").write_bytes(b"")
        damaged, orphans = store.check()
        assert [entry.view for entry in damaged] == ["a.png", "b.png"]
        assert orphans == ["orphan-0123456789abcdef.npy"]

    def test_nothing_is_ever_unpickled(self, tmp_path):
        class Bomb:
            def __reduce__(self):
                return os.mkdir, (str(tmp_path / "exploded"),)

        put(tmp_path, BLANK)
        (entry,) = WeightStore(tmp_path).entries.values()
        buffer = io.BytesIO()
        np.save(buffer, np.array([[Bomb()]], dtype=object), allow_pickle=True)
        for data in (buffer.getvalue(), pickle.dumps(Bomb())):
            (tmp_path / entry.file).write_bytes(data)
            with pytest.raises(DamagedStoreError):
                read_map(tmp_path, replace(entry, sha256=hashlib.sha256(data).hexdigest()))
        assert not (tmp_path / "exploded").exists()

    @pytest.mark.parametrize("file", ["../secret-0123456789abcdef.npy", "/etc/x-0123456789abcdef.npy", "a.npy", ""])
    def test_a_manifest_cannot_lead_out_of_the_store(self, tmp_path, file):
        put(tmp_path, BLANK)
        forged = [replace(BLANK, file=file, sha256="0" * 64)]
        (tmp_path / MANIFEST).write_bytes(manifest_bytes(forged))
        with pytest.raises(DamagedStoreError):
            WeightStore(tmp_path)

    def test_a_newer_version_is_said_to_be_newer(self, tmp_path):
        put(tmp_path, BLANK)
        document = json.loads((tmp_path / MANIFEST).read_text())
        (tmp_path / MANIFEST).write_text(json.dumps(dict(document, version=VERSION + 1, entries={"other": "layout"})))
        for opened in (WeightStore, lambda path: StoreWriter(path).__enter__()):
            with pytest.raises(LegsError, match="newer legs-loss"):
                opened(tmp_path)

    def test_no_store(self, tmp_path):
        for path in (tmp_path, tmp_path / "absent"):
            with pytest.raises(LegsError, match="not a store"):
                WeightStore(path)

    def test_a_folder_that_cannot_be_made(self, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(LegsError, match="cannot write"), StoreWriter(tmp_path / "file" / "store"):
            pass


class TestWriters:
    @pytest.mark.slow
    @needs_fork
    def test_killed_at_any_line_the_store_is_usable(self, tmp_path):
        """Kill a writer that replaces one map and adds another, at every line that it runs."""
        outcomes = set()
        for line in itertools.count(1):
            folder = tmp_path / str(line)
            put(folder, *views("a.png", "b.png"))
            finished = killed_at_line(line, lambda: put(folder, *views("a.png", "c.png"), shift=7))  # noqa: B023
            store = WeightStore(folder)
            assert store.check()[0] == []
            content = {
                entry.view: float(store.normalised_response(entry)[0, 0]) > 0 for entry in store.entries.values()
            }
            outcomes.add(tuple(content.items()))
            put(folder, *views("d.png"))  # the next writer sweeps what was left
            assert WeightStore(folder).check() == ([], [])
            assert len(list(folder.glob("*.npy"))) == len(content) + 1
            assert not list(folder.glob(".writing-*"))
            if finished:
                break
        assert line > 100
        # Either nothing of the commit is seen, or all of it.
        assert outcomes == {(("a.png", False), ("b.png", False)), (("a.png", True), ("b.png", False), ("c.png", True))}

    def test_who_reads_the_manifest_meanwhile_reads_the_old_one(self, tmp_path):
        put(tmp_path, BLANK)
        before = (tmp_path / MANIFEST).read_bytes()
        with open(str(tmp_path / MANIFEST), "rb") as reader:
            put(tmp_path, *views("b.png"))
            assert reader.read() == before

    @needs_fork
    def test_two_at_once_lose_nothing(self, tmp_path):
        context = multiprocessing.get_context("fork")
        writers = [context.Process(target=write_one_by_one, args=(tmp_path, name, 25)) for name in "ab"]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        store = WeightStore(tmp_path)
        assert {entry.view for entry in store.entries.values()} == {f"{n}{i}.png" for n in "ab" for i in range(25)}
        assert store.check() == ([], [])

    def test_a_living_writer_is_not_swept(self, tmp_path):
        with StoreWriter(tmp_path) as first:
            staged = [stage(first.staging, BLANK, ramp(BLANK))]
            put(tmp_path, *views("b.png"))
            first.commit(staged)
        assert {entry.view for entry in WeightStore(tmp_path).entries.values()} == {"images/a.png", "b.png"}
        assert not list(tmp_path.glob(".writing-*"))

    def test_a_full_disk_is_one_error_and_changes_nothing(self, tmp_path, monkeypatch):
        put(tmp_path, BLANK)

        def full(*_):
            raise OSError(28, "No space left on device")

        with StoreWriter(tmp_path) as writer:
            staged = [stage(writer.staging, BLANK, ramp(BLANK, 5))]
            monkeypatch.setattr("legs_loss.store.writing.write_parts", full)
            with pytest.raises(LegsError, match=r"cannot write to .*No space left"):
                writer.commit(staged)
        monkeypatch.undo()
        assert np.array_equal(read_map(tmp_path, *WeightStore(tmp_path).entries.values()), ramp(BLANK).astype("f2"))

    def test_files_of_others_are_left_alone(self, tmp_path):
        for name in ("features.npy", "notes.txt", "a-b.npy"):
            (tmp_path / name).write_text("mine")
        put(tmp_path, BLANK)
        assert all((tmp_path / name).exists() for name in ("features.npy", "notes.txt", "a-b.npy"))


def write_one_by_one(folder, name, count):
    for i in range(count):
        put(folder, *views(f"{name}{i}.png"))


def killed_at_line(line, work):
    """Do ``work`` in a child that is killed when it reaches the ``line``-th line of the store's code it runs.

    Return whether it finished before.
    """
    child = os.fork()
    if child == 0:
        left = [line]

        def trace(frame, event, _):
            if os.path.dirname(frame.f_code.co_filename) != os.path.dirname(store_module.__file__):
                return None
            if event == "line":
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
            return trace

        sys.settrace(trace)
        try:
            work()
        finally:
            os._exit(0)
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL)
    return status == 0


class TestFingerprint:
    def test_is_the_same_for_every_form_of_an_image(self):
        pixels = np.arange(256 * 3, dtype=np.uint32).astype(np.uint8).reshape(16, 16, 3)
        tensor = torch.from_numpy(pixels).permute(2, 0, 1) / 255.0
        name = fingerprint(pixels)
        assert len(name) == 32
        for form in (tensor, tensor.contiguous(), tensor.double(), tensor.half(), tensor.numpy(), pixels[::1].copy()):
            assert fingerprint(form) == name
        assert fingerprint(pixels.astype(np.uint16) * 257) == name
        assert fingerprint(tensor.clone().requires_grad_()) == name

    def test_sees_what_8_bits_do_not(self):
        pixels = np.tile(np.arange(100, 116, dtype=np.uint8), (16, 3, 1)).transpose(0, 2, 1)
        image = torch.from_numpy(np.ascontiguousarray(pixels)).permute(2, 0, 1) / 255.0
        shifted = image.clone()
        shifted[0, 5, 5] += 0.4 / 255  # rounds to the same 8 bits
        finer = pixels.astype(np.uint16) * 257
        finer[5, 5, 0] += 100
        names = [
            fingerprint(form) for form in (image, shifted, finer, torch.from_numpy(finer / 65535).permute(2, 0, 1))
        ]
        assert names[2] == names[3]
        assert len(set(names)) == 3
        assert fingerprint(image * float("inf")) != names[0]

    def test_differs_for_any_other_image(self):
        pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
        others = [pixels[::-1], pixels.reshape(4, 2, 3), pixels[..., :1], pixels ^ 1, pixels[:, :, ::-1]]
        others += [
            np.where(np.arange(24).reshape(2, 4, 3) == i, pixels + 1, pixels).astype(np.uint8) for i in range(24)
        ]
        names = {fingerprint(image) for image in [pixels, *others]}
        assert len(names) == 1 + len(others)
