"""The embedded scene: its ray caster by hand-worked rays, and the files as a capture whose poses are exact."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Dict

import numpy as np
import pytest

from legs_loss.lab.embedded import write_embedded_scene
from legs_loss.lab.embedded.raycast import Lamp, Quad, Sphere, Tube, bake_light, render
from legs_loss.lab.embedded.textures import text_mask
from legs_loss.scenes import load_training_image, read_scene

WHITE = np.ones((1, 1, 3), np.float32)
LAMP = Lamp(np.array([0.0, 0.0, 10.0]), 0.5)


def rays(*directions) -> np.ndarray:
    return np.array(directions, float)


def test_a_ray_meets_a_sphere_where_it_should() -> None:
    sphere = Sphere((0, 0, 5), 2.0, WHITE)
    hits = sphere.intersect(np.zeros(3), rays((0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 0, 0.5)))
    np.testing.assert_allclose(hits.distance, [3, np.inf, np.inf, 6])  # in units of the direction's length


def test_a_ray_meets_a_parallelogram_at_its_texture_coordinates() -> None:
    quad = Quad((-1, -1, 4), (2, 0, 0), (0, 4, 0), WHITE)
    hits = quad.intersect(np.zeros(3), rays((0, 0, 1), (0.2, 0.5, 1), (0.3, 0, 1), (0, 0, -1)))
    np.testing.assert_allclose(hits.distance, [4, 4, np.inf, np.inf])
    np.testing.assert_allclose([hits.u[:2], hits.v[:2]], [[0.5, 0.9], [0.25, 0.75]])


def test_a_round_parallelogram_has_no_corners() -> None:
    disc = Quad((-1, -1, 1), (2, 0, 0), (0, 2, 0), WHITE, round=True)
    hits = disc.intersect(np.zeros(3), rays((0.7, 0.7, 1), (0.8, 0.8, 1), (0.99, 0, 1)))
    assert np.isfinite(hits.distance).tolist() == [True, False, True]


def test_a_ray_meets_a_tube_only_between_its_ends() -> None:
    tube = Tube((-1, 0, 3), (1, 0, 3), 0.5, WHITE)
    hits = tube.intersect(np.zeros(3), rays((0, 0, 1), (0.3, 0, 1), (0.5, 0, 1), (0, 0.1, 1)))
    np.testing.assert_allclose(hits.distance[:2], [2.5, 2.5])
    assert np.isinf(hits.distance[2])
    # y = 0.1 z and y^2 + (z - 3)^2 = 0.25
    np.testing.assert_allclose(hits.distance[3], (6 - np.sqrt(36 - 4 * 1.01 * 8.75)) / 2.02)
    np.testing.assert_allclose(hits.v[:2], [0.5, 0.875])


def test_light_is_lambert_and_a_ball_shades_the_floor_below_it() -> None:
    floor = Quad((-4, -4, 0), (8, 0, 0), (0, 8, 0), WHITE)
    ball = Sphere((0, 0, 2), 1.0, WHITE)
    bake_light([floor, ball], LAMP, cell=0.5)
    assert floor.light is not None
    assert floor.light.shape == (16, 16)
    corner = 0.42 + 0.68 * 10 / np.sqrt(100 + 2 * 3.75**2)  # ambient + lamp * cos of the angle to its middle
    assert floor.light[0, 0] == pytest.approx(corner, abs=5e-3)
    assert floor.light[7:9, 7:9] == pytest.approx(0.42)  # in the core shadow only the ambient light is left


def test_the_picture_and_its_depth_by_hand() -> None:
    texture = np.zeros((1, 2, 3), np.float32)
    texture[0, 1] = 1.0
    wall = Quad((-8, -8, 4), (16, 0, 0), (0, 16, 0), texture)  # not baked: shows its texture as it is
    ball = Sphere((0, 0, 3), 0.25, np.zeros((1, 1, 3), np.float32))
    picture, depth = render([wall, ball], LAMP, np.eye(4), focal=4.0, width=6, height=5, samples=3)
    assert picture.shape == (5, 6, 3)
    assert picture[0, :, 0].tolist() == [0, 0, 0, 1, 1, 1]
    assert depth[0].tolist() == [4.0] * 6  # along the axis, not along the ray
    # The ball's image has radius 4 * 0.25 / sqrt(9 - 0.0625) = 1/3 pixel about the corner of the middle pixels.
    assert 0.5 < picture[2, 3, 0] < 1


def test_supersampling_averages_an_edge_inside_a_pixel() -> None:
    texture = np.zeros((1, 2, 3), np.float32)
    texture[0, 1] = 1.0
    wall = Quad((-1, -8, 1), (2, 0, 0), (0, 16, 0), texture)  # the edge at x = 0 cuts the middle pixel in half
    picture, _ = render([wall], LAMP, np.eye(4), focal=1.0, width=1, height=1, samples=4)
    assert picture.ravel().tolist() == [0.5] * 3


def test_every_glyph_is_five_by_seven_and_none_repeats() -> None:
    letters = "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.-+=()"
    masks = {text_mask(letter).tobytes() for letter in letters}
    assert len(masks) == len(letters)
    assert all(text_mask(letter).shape == (7, 5) for letter in letters)


def digests(root: Path) -> Dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_files_are_a_colmap_scene_and_the_same_every_time(tmp_path: Path) -> None:
    size = {"views": 3, "width": 24, "height": 18, "points": 50, "samples": 1}
    first = write_embedded_scene(tmp_path / "a", **size)
    second = write_embedded_scene(tmp_path / "b", **size)
    names = ["images/table_000.png", "images/table_001.png", "images/table_002.png"]
    names += ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"]
    assert sorted(digests(first)) == names
    assert digests(first) == digests(second)
    assert digests(first) != digests(write_embedded_scene(tmp_path / "c", seed=1, **size))


def test_a_user_reads_it_like_a_capture(tiny_scene: Path) -> None:
    scene = read_scene(tiny_scene)
    assert scene.kind == "colmap"
    assert len(scene.views) == 12
    assert scene.points is not None
    assert scene.points.xyz.shape == (900, 3)
    for view in scene.views:
        assert view.camera is not None
        assert load_training_image(view).shape == (48, 64, 3)
        rotation = view.camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_points_land_on_their_colour_in_views_they_were_not_taken_from(tmp_path: Path) -> None:
    """Poses, depths and pixels agree: a point found in one view has its colour in others, where it is not hidden."""
    scene = read_scene(write_embedded_scene(tmp_path, views=6, width=96, height=72, points=600, samples=2))
    points = scene.points
    assert points is not None
    source = np.repeat(np.arange(6), 100)  # points are stored view by view
    errors: Dict[int, list] = {0: [], 9: []}  # by how many pixels beside the point the photograph is looked at
    for index, view in enumerate(scene.views):
        camera = view.camera
        assert camera is not None
        image = load_training_image(view).astype(float)
        local = points.xyz @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        x = local[:, 0] / local[:, 2] * camera.fx + camera.cx
        y = local[:, 1] / local[:, 2] * camera.fy + camera.cy
        inside = (x >= 0) & (x < 96) & (y >= 0) & (y < 63) & (local[:, 2] > 0) & (source != index)
        for shift, found in errors.items():
            pixel = image[y[inside].astype(int) + shift, x[inside].astype(int)]
            found.append(np.abs(pixel - points.rgb[inside]).mean(1))
    right, beside = (np.concatenate(found) for found in errors.values())
    assert len(right) > 500
    assert np.median(right) < 0.75 * np.median(beside)
