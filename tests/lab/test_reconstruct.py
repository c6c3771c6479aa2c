"""`legs scene`: photographs to a COLMAP scene, against cameras that are known."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from legs_loss.cli import main
from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.scenes import read_scene

pycolmap = pytest.importorskip("pycolmap")


def centres(scene):
    """Return where each view was taken, by its file's name."""
    return {
        view.name.rsplit("/", 1)[-1]: -view.camera.world_to_camera[:3, :3].T @ view.camera.world_to_camera[:3, 3]
        for view in scene.views
    }


def aligned_error(found, known):
    """Return the RMS distance after the best similarity transform (Umeyama), over the extent of ``known``."""
    a, b = found - found.mean(0), known - known.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    d = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(d)).sum() / (a**2).sum()
    return np.sqrt(((scale * a @ (u @ d @ vt).T - b) ** 2).sum(1).mean()) / np.ptp(b, axis=0).max()


@pytest.mark.slow
def test_cameras_of_a_drawn_scene_are_found_again(tmp_path, capsys):
    truth = read_scene(write_embedded_scene(tmp_path / "drawn", views=24, width=320, height=240, points=500))
    code = main(["scene", str(tmp_path / "drawn" / "images"), str(tmp_path / "out"), "--threads", "1"])
    assert code in (0, 1), capsys.readouterr().err
    made, known = centres(read_scene(tmp_path / "out")), centres(truth)
    assert len(made) >= 12
    assert ("no camera was found" in capsys.readouterr().err) == (code == 1) == (len(made) < 24)
    names = sorted(made)
    assert aligned_error(np.stack([made[n] for n in names]), np.stack([known[n] for n in names])) < 0.02
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawn", "out"]


def error_of(capsys, *words):
    assert main(["scene", *map(str, words)]) == 2
    return capsys.readouterr().err


def test_errors_say_what_to_do_and_leave_nothing(tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    assert "there is no folder" in error_of(capsys, photos, out)
    photos.mkdir()
    assert "at least 3 are needed" in error_of(capsys, photos, out)
    for name in ("a.webp", "b.NEF"):  # COLMAP reads neither
        (photos / name).write_bytes(b"")
    assert "needed; 2 file(s) in a format that is not read here are left out: a.webp, b.NEF" in error_of(
        capsys, photos, out
    )
    rng = np.random.default_rng(0)
    for i in range(3):
        Image.fromarray(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(photos / f"{i}.png")
    said = error_of(capsys, photos, out, "--threads", 1)
    assert "no scene can be made" in said
    assert said.startswith("legs: note: 2 file(s) in a format that is not read here are left out: a.webp, b.NEF")
    assert "features of 3 photographs ...\n" in said
    (photos / "3.png").write_bytes(b"not a photograph")
    assert "3.png: not an image" in error_of(capsys, photos, out)
    assert "--overlap must be" in error_of(capsys, photos, out, "--overlap", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]
    out.mkdir()
    assert "exists already" in error_of(capsys, photos, out)
