"""``legs info`` reports a store's contents and its faults."""

from __future__ import annotations

from legs_loss.precompute import precompute
from legs_loss.scenes import read_scene
from legs_loss.store import WeightStore
from tests.support import legs


class TestInfo:
    def test_what_a_store_holds(self, scene, store):
        precompute(read_scene(scene), spec="eggs", resolution=2)
        for path in (store, scene):
            done = legs("info", path)
            assert done.returncode == 0, done.stderr
            for line in ("views      6", "maps       12", "20x15 (6), 40x30 (6)", "laplacian p=2", "damaged    none"):
                assert line in done.stdout

    def test_damaged_and_orphaned_files_are_named(self, store):
        damaged = sorted(WeightStore(store).entries.values(), key=lambda entry: entry.view)[1]
        data = (store / damaged.file).read_bytes()
        (store / damaged.file).write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        (store / "lost-0123456789abcdef.npy").write_bytes(b"")
        done = legs("info", store)
        assert done.returncode == 1
        assert "damaged    1" in done.stdout
        assert damaged.view in done.stdout
        assert "lost-0123456789abcdef.npy" in done.stdout
        assert "legs precompute again" in done.stderr

    def test_a_damaged_manifest(self, store):
        manifest = store / "manifest.json"
        manifest.write_bytes(manifest.read_bytes().replace(b"laplacian", b"laplacien", 1))
        done = legs("info", store)
        assert done.returncode == 1
        assert "manifest.json is damaged" in done.stderr

    def test_no_store(self, tmp_path):
        done = legs("info", tmp_path)
        assert done.returncode == 2
        assert "is neither a store" in done.stderr

    def test_a_scene_without_a_store_or_that_cannot_be_read(self, scene):
        done = legs("info", scene)
        assert done.returncode == 2
        assert f"6 photograph(s) and no weight maps yet: legs precompute {scene} makes them" in done.stderr
        images = scene / "sparse" / "0" / "images.bin"
        images.write_bytes(images.read_bytes().replace(b"2.png", b"\xe9.png"))
        for command in ("info", "precompute"):  # one reason in both
            done = legs(command, scene)
            assert done.returncode == 2
            assert "the name '\\xe9.png' of an image is not in UTF-8" in done.stderr
