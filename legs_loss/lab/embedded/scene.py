"""The embedded scene: a table in a room, made wholly by code and written out like a user's own capture.

It has what the loss is about, with exact poses: sharp texture at several scales (brick, tiles, planks, stripes, a
star chart), text from large to barely readable, thin wires in front of busy and of plain walls, smooth shaded balls
and plaster, soft shadows, and objects that hide one another as the camera moves.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import List, Tuple, Union

import numpy as np

from legs_loss.lab.embedded import textures
from legs_loss.lab.embedded.colmap_writer import write_colmap
from legs_loss.lab.embedded.raycast import Lamp, Quad, Sphere, Tube, bake_light, render
from legs_loss.scenes.model import Camera, PointCloud
from legs_loss.system.files import write_whole

LAMP = Lamp(np.array([-0.5, -0.6, 2.95]), 0.55)
TARGET = np.array([0.0, 0.25, 0.98])


def _room(random: np.random.RandomState) -> List[Quad]:
    left, right, front, back, top = -3.4, 3.4, -3.6, 2.6, 3.0
    width, depth = right - left, back - front
    floor = textures.checker((930, 1020), 60, (0.34, 0.33, 0.35), (0.72, 0.69, 0.64), random)
    brick = textures.brick((600, 1360), 80, 30, random)
    wallpaper = textures.stripes(
        (8, 1240),
        (50, 6, 22, 6, 50, 2, 8, 2),
        ((0.58, 0.68, 0.62), (0.26, 0.38, 0.36), (0.78, 0.80, 0.70), (0.26, 0.38, 0.36))
        + ((0.58, 0.68, 0.62), (0.80, 0.55, 0.35), (0.58, 0.68, 0.62), (0.80, 0.55, 0.35)),
    )
    plaster = textures.tint(textures.fractal_noise((400, 820), 6, 5, random), (0.50, 0.52, 0.60), (0.80, 0.80, 0.82))
    ceiling = textures.plain((2, 2), (0.85, 0.84, 0.80))
    wall = textures.plain((2, 2), (0.60, 0.56, 0.50))
    return [
        Quad((left, back, 0), (width, 0, 0), (0, -depth, 0), floor, casts_shadow=False),
        Quad((left, back, top), (width, 0, 0), (0, -depth, 0), ceiling, casts_shadow=False),
        Quad((left, back, top), (width, 0, 0), (0, 0, -top), brick, casts_shadow=False),
        Quad((right, front, top), (-width, 0, 0), (0, 0, -top), wall, casts_shadow=False),
        Quad((left, front, top), (0, depth, 0), (0, 0, -top), wallpaper, casts_shadow=False),
        Quad((right, back, top), (0, -depth, 0), (0, 0, -top), plaster, casts_shadow=False),
    ]


def _pictures(random: np.random.RandomState) -> List[Quad]:
    """Return the surfaces on the walls: a poster, a star chart, a board of text, and a rug below."""
    dark, red, paper = (0.10, 0.11, 0.15), (0.72, 0.14, 0.12), (0.93, 0.91, 0.84)
    poster = textures.plain((260, 420, 3)[:2], (0.13, 0.24, 0.42))
    textures.write(poster, "LEGS", 34, 66, 12, (0.96, 0.86, 0.42))
    textures.write(poster, "LAPLACIAN ENHANCED", 142, 49, 3, paper)
    textures.write(poster, "GAUSSIAN SPLATTING", 174, 49, 3, paper)
    textures.write(poster, "W = 1 + 10 F(E)", 214, 124, 2, (0.96, 0.86, 0.42))
    textures.framed(poster, 9, (0.88, 0.84, 0.76))

    chart = textures.framed(textures.star(280, 18), 6, (0.25, 0.16, 0.10))

    board = textures.plain((300, 440), paper)
    lines = (
        ("EDGES", 12, 8, dark),
        ("THIN WIRES", 80, 5, red),
        ("SMALL LETTERS", 124, 4, dark),
        ("PACK MY BOX WITH FIVE", 162, 3, dark),
        ("DOZEN LIQUOR JUGS. 0123456789", 192, 2, red),
        ("SPHINX OF BLACK QUARTZ JUDGE MY VOW", 214, 2, dark),
    )
    for text, row, scale, colour in lines:
        textures.write(board, text, row, 14, scale, colour)
    for column in range(14, 424, 4):  # bars that get narrower
        if (column // 4) % max(2, 8 - column // 60) < max(1, 4 - column // 120):
            board[240:284, column : column + 4] = dark
    textures.framed(board, 5, (0.35, 0.22, 0.12))

    rug = textures.stripes(
        (8, 360), (24, 4, 8, 4), ((0.50, 0.16, 0.18), (0.90, 0.82, 0.66), (0.20, 0.22, 0.36), (0.90, 0.82, 0.66))
    )
    tiles = textures.checker((160, 160), 8, (0.16, 0.30, 0.28), (0.86, 0.84, 0.70), random)
    textures.framed(tiles, 8, (0.20, 0.14, 0.10))
    return [
        Quad((-2.35, 2.585, 2.25), (1.60, 0, 0), (0, 0, -1.0), poster),
        Quad((1.25, 2.585, 2.35), (1.10, 0, 0), (0, 0, -1.1), chart),
        Quad((3.385, 1.5, 2.05), (0, -0.95, 0), (0, 0, -0.95), tiles),
        Quad((-0.30, 0.62, 1.36), (0.86, -0.10, 0), (0, 0.06, -0.58), board),
        Quad((-1.7, 1.15, 0.004), (3.4, 0, 0), (0, -2.2, 0), rug, casts_shadow=False),
    ]


def _box(
    centre: Tuple[float, float, float], size: Tuple[float, float, float], turn: float, faces: List[np.ndarray]
) -> List[Quad]:
    """Return a box turned about the vertical: four sides (front, right, back, left) and the top."""
    c, s = np.cos(turn), np.sin(turn)
    x, y = np.array([c, s, 0]) * size[0] / 2, np.array([-s, c, 0]) * size[1] / 2
    z = np.array([0, 0, size[2] / 2])
    middle = np.asarray(centre, float)
    corners = ((-x - y, 2 * x), (x - y, 2 * y), (x + y, -2 * x), (-x + y, -2 * y))
    sides = [
        Quad(middle + corner + z, across, -2 * z, faces[i % len(faces)]) for i, (corner, across) in enumerate(corners)
    ]
    return sides + [Quad(middle - x + y + z, 2 * x, -2 * y, faces[-1])]


def _furniture(random: np.random.RandomState) -> List:
    wood = textures.planks((320, 520), 54, random)
    edge = textures.planks((12, 260), 12, random)
    leg = textures.plain((2, 2), (0.30, 0.19, 0.11))
    surfaces: List = _box((0, 0, 0.72), (2.6, 1.6, 0.06), 0.0, [edge, edge, edge, edge, wood])
    for x in (-1.2, 1.2):
        for y in (-0.7, 0.7):
            surfaces += _box((x, y, 0.345), (0.09, 0.09, 0.69), 0.0, [leg])
    crate = textures.framed(textures.planks((140, 140), 20, random), 12, (0.40, 0.26, 0.14))
    surfaces += _box((-2.25, 1.35, 0.36), (0.72, 0.72, 0.72), 0.5, [crate])
    ball = textures.stripes((8, 240), (20, 20, 20), ((0.9, 0.9, 0.85), (0.15, 0.4, 0.6)))
    return surfaces + [Sphere((2.1, 1.3, 0.42), 0.42, ball, gloss=0.25)]


def _still_life(random: np.random.RandomState) -> List:
    """Return the surfaces of what stands on the table (its top is at 0.75 m) and hangs over it."""
    top = 0.75
    letters = textures.plain((96, 96), (0.90, 0.78, 0.30))
    textures.write(letters, "LEGS", 14, 3, 4, (0.12, 0.12, 0.30))
    textures.write(letters, "3DGS 30000", 52, 19, 1, (0.12, 0.12, 0.30))
    textures.write(letters, "8D 1.48 2.90", 66, 13, 1, (0.60, 0.10, 0.10))
    textures.framed(letters, 4, (0.12, 0.12, 0.30))
    fine = textures.checker((96, 96), 6, (0.10, 0.10, 0.12), (0.95, 0.95, 0.92), random)
    small_brick = textures.brick((96, 96), 24, 9, random)
    zebra = textures.stripes((4, 96), (9, 9, 3, 3, 5, 3), ((0.92, 0.30, 0.20), (0.96, 0.94, 0.90)))
    surfaces: List = _box((-0.78, 0.12, top + 0.21), (0.42, 0.42, 0.42), 0.45, [letters, fine, small_brick, zebra])

    matte = textures.plain((2, 2), (0.86, 0.36, 0.22))
    blue = textures.plain((2, 2), (0.22, 0.38, 0.72))
    marble = textures.tint(textures.fractal_noise((90, 180), 5, 4, random), (0.22, 0.42, 0.30), (0.88, 0.92, 0.80))
    pearl = textures.plain((2, 2), (0.82, 0.80, 0.84))
    surfaces += [
        Sphere((-0.12, -0.24, top + 0.2), 0.20, matte, gloss=0.15),
        Sphere((0.42, -0.42, top + 0.11), 0.11, blue, gloss=0.45),
        Sphere((-0.46, -0.48, top + 0.09), 0.09, marble),
        Sphere((1.05, -0.05, top + 0.14), 0.08, pearl, gloss=0.3),
    ]

    # A mug full of sticks.
    spiral = textures.stripes((1, 120), (14, 14, 14, 4), ((0.95, 0.93, 0.88), (0.14, 0.42, 0.42)))
    mug = np.stack([np.roll(spiral[0], shift, axis=0) for shift in range(60)])
    x, y = 0.66, 0.22
    inside = textures.plain((2, 2), (0.16, 0.15, 0.15))
    surfaces.append(Tube((x, y, top), (x, y, top + 0.30), 0.125, mug, gloss=0.2))
    surfaces.append(Quad((x - 0.125, y + 0.125, top + 0.295), (0.25, 0, 0), (0, -0.25, 0), inside, round=True))
    shades = ((0.12, 0.12, 0.14), (0.86, 0.20, 0.16), (0.95, 0.78, 0.20), (0.92, 0.92, 0.90))
    for k in range(9):
        angle, lean = 2 * np.pi * k / 9.0, 0.10 + 0.12 * ((k * 5) % 9) / 9.0
        away = np.array([np.cos(angle), np.sin(angle), 0.0])
        foot = np.array([x, y, top + 0.28]) + 0.05 * away
        tip = foot + lean * away + np.array([0, 0, 0.34 + 0.03 * ((k * 7) % 9)])
        surfaces.append(Tube(foot, tip, 0.0055, textures.plain((1, 1), shades[k % 4])))

    # A wire cage around a small ball.
    black, steel = textures.plain((1, 1), (0.08, 0.08, 0.09)), textures.plain((1, 1), (0.62,) * 3)
    centre, half = np.array([1.05, -0.05, top + 0.18]), 0.17
    turn = np.array([[0.82, -0.57, 0], [0.57, 0.82, 0], [0, 0, 1]])
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * half
    for i in range(8):
        for j in range(i):
            if np.count_nonzero(corners[i] != corners[j]) == 1:
                a, b = centre + turn @ corners[i], centre + turn @ corners[j]
                surfaces.append(Tube(a, b, 0.006, black))

    # Lines across the room, and a lamp shade on its cable.
    for y0, z0, y1, z1, tone in ((1.55, 2.45, 1.25, 2.15, black), (1.65, 2.2, 1.1, 1.95, steel)):
        surfaces.append(Tube((-3.39, y0, z0), (3.39, y1, z1), 0.009, tone))
    for k in range(7):
        x = -0.62 + 0.13 * k
        below = (x, 0.35 - 0.02 * k, top)
        surfaces.append(Tube(below, (x + 0.05, 0.34 - 0.02 * k, top + 0.42), 0.004, steel))
    shade = textures.stripes((1, 120), (10, 5), ((0.92, 0.66, 0.30), (0.80, 0.46, 0.20)))
    surfaces.append(Tube((0.55, 1.15, 2.02), (0.55, 1.15, 2.99), 0.008, black))
    surfaces.append(Sphere((0.55, 1.15, 1.84), 0.20, shade))
    return surfaces


def _surfaces(seed: int) -> List:
    random = np.random.RandomState(seed)
    return _room(random) + _pictures(random) + _furniture(random) + _still_life(random)


def _pose(index: int, count: int) -> np.ndarray:
    """Return world to camera, [4, 4]: a hand-held sweep in front of the table, up and down as it goes."""
    phase = 2 * np.pi * index / count + 0.4
    azimuth = np.radians(58) * np.sin(phase)
    distance = 2.75 + 0.25 * np.cos(2 * phase + 0.7)
    height = 1.55 + 0.42 * np.sin(3 * phase + 1.0)
    eye = np.array([distance * np.sin(azimuth), 0.1 - distance * np.cos(azimuth), height])
    forward = TARGET + [0.1 * np.sin(5 * phase), 0, 0.08 * np.cos(4 * phase)] - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def _sparse_points(
    picture: np.ndarray, depth: np.ndarray, camera: Camera, count: int, random: np.random.RandomState
) -> Tuple[np.ndarray, np.ndarray]:
    """Return points as structure from motion finds them, on texture and edges: float [N, 3] and uint8 [N, 3]."""
    gray = picture.mean(axis=2)
    detail = np.hypot(*np.gradient(gray)) + 0.02
    chosen = random.choice(gray.size, count, replace=False, p=(detail / detail.sum()).ravel())
    row, column = np.divmod(chosen, camera.width)
    z = depth[row, column]
    x = (column + 0.5 - camera.cx) / camera.fx * z
    y = (row + 0.5 - camera.cy) / camera.fy * z
    local = np.stack([x, y, z], axis=1) + 0.002 * z[:, None] * random.randn(count, 3)
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (local - translation) @ rotation, np.round(255 * picture[row, column]).astype(np.uint8)


def write_embedded_scene(
    path: Union[str, Path],
    views: int = 32,
    width: int = 288,
    height: int = 216,
    points: int = 10000,
    samples: int = 3,
    seed: int = 0,
) -> Path:
    """Write the scene in COLMAP's layout: ``images/*.png`` and ``sparse/0``. Returns the folder.

    ``samples`` x ``samples`` rays are averaged a pixel. The same arguments give the same files. Takes some seconds at
    the default size on one core.
    """
    from PIL import Image

    root = Path(path)
    (root / "images").mkdir(parents=True, exist_ok=True)
    surfaces = _surfaces(seed)
    bake_light(surfaces, LAMP)
    random = np.random.RandomState(seed)
    focal = 0.95 * width
    cameras, xyz, rgb = {}, [], []
    for index in range(views):
        pose = _pose(index, views)
        picture, depth = render(surfaces, LAMP, pose, focal, width, height, samples)
        camera = Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose)
        name = f"table_{index:03d}.png"
        photograph = Image.fromarray(np.round(255 * picture).astype(np.uint8))
        write_whole(root / "images" / name, partial(photograph.save, format="PNG"))
        cameras[name] = camera
        share = points * (index + 1) // views - points * index // views
        places, colours = _sparse_points(picture, depth, camera, share, random)
        xyz.append(places)
        rgb.append(colours)
    cloud = PointCloud(np.concatenate(xyz).astype(np.float32), np.concatenate(rgb))
    write_colmap(root, cameras, cloud)
    return root
