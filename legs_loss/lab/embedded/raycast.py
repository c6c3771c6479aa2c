"""A small ray caster in numpy: textured parallelograms, spheres and tubes under one soft lamp.

It renders the embedded scene. Cameras are pinholes with OpenCV axes (x right, y down, z forward); all lengths are
in metres. Shadows are soft: `bake_light` shoots rays from every parallelogram to points spread over the lamp, once a
scene, and keeps the result as a small light map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as np

Vector = Union[Sequence[float], np.ndarray]  # three numbers

AMBIENT, LAMP = 0.42, 0.68
NEAR = 0.05


class Hits(NamedTuple):
    """The hits of N rays on a surface: distance along the ray (inf: missed), texture coordinates in [0, 1]."""

    distance: np.ndarray
    u: np.ndarray
    v: np.ndarray


class Lamp(NamedTuple):
    """A round horizontal lamp that shines down."""

    centre: np.ndarray
    radius: float

    def points(self, count: int) -> np.ndarray:
        """Return ``count`` points spread evenly over the lamp, [count, 3]."""
        k = np.arange(count)
        radius = self.radius * np.sqrt((k + 0.5) / count)
        angle = k * 2.399963  # the golden angle
        return self.centre + np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], axis=1)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)


def _look_up(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    height, width = texture.shape[:2]
    column = np.minimum((u * width).astype(np.int32), width - 1)
    row = np.minimum((v * height).astype(np.int32), height - 1)
    return texture.reshape(height * width, -1)[row * width + column]


def _bilinear(table: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    height, width = table.shape
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip(v * height - 0.5, 0, height - 1)
    c, r = np.minimum(x.astype(np.int32), width - 2), np.minimum(y.astype(np.int32), height - 2)
    fx, fy, flat, start = x - c, y - r, table.ravel(), r * width + c
    top = flat[start] * (1 - fx) + flat[start + 1] * fx
    bottom = flat[start + width] * (1 - fx) + flat[start + width + 1] * fx
    return top * (1 - fy) + bottom * fy


@dataclass(eq=False)
class Quad:
    """A parallelogram ``corner + u * across + v * down`` with a texture, or the ellipse inside it (``round=True``).

    It is seen and lit from both sides.
    """

    corner: Any  # three numbers each, arrays from here on
    across: Any
    down: Any
    texture: np.ndarray
    round: bool = False
    casts_shadow: bool = True
    light: Optional[np.ndarray] = None

    def __post_init__(self) -> None:
        self.corner, self.across, self.down = (np.asarray(one, float) for one in (self.corner, self.across, self.down))
        self.normal: np.ndarray = _unit(np.cross(self.across, self.down))
        # Rows: the dual basis, so that row @ (point - corner) is u, v and the height over the plane.
        self._dual = np.linalg.inv(np.stack([self.across, self.down, self.normal], axis=1))

    def hull(self) -> np.ndarray:
        """Return points whose convex hull holds the surface."""
        a, b = self.across, self.down
        return self.corner + np.stack([0 * a, a, b, a + b])

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Intersect rays from ``origin`` ([3] or [N, 3]) along ``direction`` [N, 3]."""
        dual = self._dual.astype(direction.dtype)
        start = ((origin - self.corner) @ self._dual.T).astype(direction.dtype)
        u, v, height = dual @ direction.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -start[..., 2] / height
            u = u * distance + start[..., 0]
            v = v * distance + start[..., 1]
            if self.round:
                inside = (u - 0.5) ** 2 + (v - 0.5) ** 2 <= 0.25
            else:
                inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
            inside &= distance > 1e-4
        return Hits(np.where(inside, distance, np.inf), u, v)

    def shade(self, hits: Hits, origin: np.ndarray, direction: np.ndarray, lamp: Lamp) -> np.ndarray:
        """Return colours [N, 3] of the hit points of rays."""
        colour = _look_up(self.texture, hits.u, hits.v)
        if self.light is None:
            return colour
        return colour * _bilinear(self.light, hits.u, hits.v)[:, None]


class _Curved:
    """The shading of spheres and tubes: Lambert without shadows, a contact shade below, a soft highlight."""

    def __init__(self, radius: float, texture: np.ndarray, gloss: float, casts_shadow: bool) -> None:
        self.radius: float = radius
        self.texture: np.ndarray = texture
        self.gloss: float = gloss
        self.casts_shadow: bool = casts_shadow

    def normal(self, hits: Hits, point: np.ndarray) -> np.ndarray:
        """Return the normals [N, 3] at the hit points."""
        raise NotImplementedError

    def shade(self, hits: Hits, origin: np.ndarray, direction: np.ndarray, lamp: Lamp) -> np.ndarray:
        """Return colours [N, 3] of the hit points of rays."""
        point = origin + hits.distance[:, None] * direction
        normal = self.normal(hits, point)
        to_lamp = _unit(lamp.centre - point)
        facing = (normal * to_lamp).sum(1)
        wrapped = np.clip((facing + 0.25) / 1.25, 0, None)  # a large lamp lights past the terminator
        light = AMBIENT * (0.75 + 0.25 * normal[:, 2]) + LAMP * wrapped
        colour = _look_up(self.texture, hits.u, hits.v) * light[:, None]
        if self.gloss:
            half = _unit(to_lamp - _unit(direction))
            shine = np.clip((normal * half).sum(1), 0, None) ** 40
            colour = colour + self.gloss * shine[:, None]
        return colour


class Sphere(_Curved):
    """A sphere; its texture is laid out by longitude and latitude."""

    def __init__(self, centre: Vector, radius: float, texture: np.ndarray, gloss: float = 0.0) -> None:
        self.centre: np.ndarray = np.asarray(centre, float)
        super().__init__(radius, texture, gloss, True)

    def hull(self) -> np.ndarray:
        """Return points whose convex hull holds the surface."""
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
        return self.centre + self.radius * corners

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Intersect rays from ``origin`` ([3] or [N, 3]) along ``direction`` [N, 3]."""
        offset = origin - self.centre
        a = (direction * direction).sum(1)
        b = (direction * offset).sum(1)
        c = (offset * offset).sum(-1) - self.radius**2
        root = b * b - a * c
        distance = (-b - np.sqrt(np.maximum(root, 0))) / a
        distance = np.where((root > 0) & (distance > 1e-4), distance, np.inf)
        near = np.where(np.isfinite(distance), distance, 0)[:, None]
        normal = (offset + near * direction) / self.radius
        u = np.arctan2(normal[:, 1], normal[:, 0]) / (2 * np.pi) + 0.5
        v = np.arccos(np.clip(normal[:, 2], -1, 1)) / np.pi
        return Hits(distance, u, v)

    def normal(self, hits: Hits, point: np.ndarray) -> np.ndarray:
        """Return the normals [N, 3] at the hit points."""
        return (point - self.centre) / self.radius


class Tube(_Curved):
    """An open cylinder between two points: a wire, a stick, a mug. u runs around it, v along it."""

    def __init__(self, start: Vector, end: Vector, radius: float, texture: np.ndarray, gloss: float = 0.0) -> None:
        self.start: np.ndarray = np.asarray(start, float)
        # The shadow of a thin wire under a wide lamp is too faint to see.
        super().__init__(radius, texture, gloss, radius > 0.02)
        axis = np.asarray(end, float) - self.start
        self.length: float = float(np.linalg.norm(axis))
        axis = axis / self.length
        side = _unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
        self.frame: np.ndarray = np.stack([side, np.cross(axis, side), axis])  # rows

    def hull(self) -> np.ndarray:
        """Return points whose convex hull holds the surface."""
        square = self.radius * np.array([[-1, -1, 0], [-1, 1, 0], [1, -1, 0], [1, 1, 0]])
        local = np.concatenate([square, square + [0, 0, self.length]])
        return self.start + local @ self.frame

    def intersect(self, origin: np.ndarray, direction: np.ndarray) -> Hits:
        """Intersect rays from ``origin`` ([3] or [N, 3]) along ``direction`` [N, 3]."""
        o = (origin - self.start) @ self.frame.T
        d = direction.astype(float) @ self.frame.T
        a = d[:, 0] ** 2 + d[:, 1] ** 2
        b = d[:, 0] * o[..., 0] + d[:, 1] * o[..., 1]
        c = o[..., 0] ** 2 + o[..., 1] ** 2 - self.radius**2
        root = b * b - a * c
        distance = (-b - np.sqrt(np.maximum(root, 0))) / np.maximum(a, 1e-12)
        along = o[..., 2] + distance * d[:, 2]
        hit = (root > 0) & (distance > 1e-4) & (along >= 0) & (along <= self.length)
        angle = np.arctan2(o[..., 1] + distance * d[:, 1], o[..., 0] + distance * d[:, 0])
        u = angle / (2 * np.pi) + 0.5
        return Hits(np.where(hit, distance, np.inf), u, np.clip(along / self.length, 0, 1))

    def normal(self, hits: Hits, point: np.ndarray) -> np.ndarray:
        """Return the normals [N, 3] at the hit points."""
        angle = (hits.u - 0.5) * 2 * np.pi
        return np.cos(angle)[:, None] * self.frame[0] + np.sin(angle)[:, None] * self.frame[1]


def bake_light(surfaces: Sequence[Any], lamp: Lamp, cell: float = 0.06, lamp_points: int = 12) -> None:
    """Give every `Quad` its light map: one value a ``cell`` (metres), soft shadows included."""
    casters = [surface for surface in surfaces if surface.casts_shadow]
    targets = lamp.points(lamp_points)
    for quad in surfaces:
        if not isinstance(quad, Quad):
            continue
        rows = int(np.clip(np.linalg.norm(quad.down) / cell, 4, 48))
        columns = int(np.clip(np.linalg.norm(quad.across) / cell, 4, 48))
        v, u = np.mgrid[:rows, :columns] + 0.5
        points = quad.corner + (u / columns).reshape(-1, 1) * quad.across + (v / rows).reshape(-1, 1) * quad.down
        to_lamp = lamp.centre - points
        side = np.sign(to_lamp @ quad.normal)[:, None] * quad.normal
        received = np.zeros(len(points))
        # The lamp is above everything: what lies wholly below this surface cannot shade it.
        floor = points[:, 2].min()
        above = [c for c in casters if c is not quad and c.hull()[:, 2].max() > floor]
        for target in targets:
            start = points + 1e-3 * side
            ray = target - start
            lit = np.ones(len(points), bool)
            for caster in above:
                lit &= caster.intersect(start, ray).distance > 1
            received += lit * np.abs((_unit(ray) * quad.normal).sum(1))
        light = (received / lamp_points).reshape(rows, columns)
        quad.light = (AMBIENT + LAMP * _blurred(light)).astype(np.float32)


def _blurred(table: np.ndarray) -> np.ndarray:
    padded = np.pad(table, 1, mode="edge")
    rows = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
    return (rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 4


def render(
    surfaces: Sequence[Any],
    lamp: Lamp,
    world_to_camera: np.ndarray,
    focal: float,
    width: int,
    height: int,
    samples: int = 3,
) -> Tuple[np.ndarray, np.ndarray]:
    """Render one picture with ``samples`` x ``samples`` rays a pixel, and its depth.

    Returns the picture float32 [height, width, 3] in [0, 1], and the depth along the optical axis at one ray next to
    the centre of each pixel, float32 [height, width]. The principal point is the middle of the picture.
    """
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    origin = -rotation.T @ translation
    xs = ((np.arange(width * samples) + 0.5) / samples - width / 2.0) / focal
    ys = ((np.arange(height * samples) + 0.5) / samples - height / 2.0) / focal
    rectangles = [_screen_rectangle(s.hull() @ rotation.T + translation, xs, ys) for s in surfaces]
    picture = np.empty((height, width, 3), np.float32)
    depth = np.empty((height, width), np.float32)
    strip = max(1, 48 // samples)  # so many rows of pixels at a time stay in the cache
    for top in range(0, height, strip):
        rows = slice(top * samples, min(top + strip, height) * samples)
        colour, distance = _render_rows(surfaces, lamp, rotation, origin, xs, ys, rows, rectangles)
        count = distance.shape[0] // samples
        rows_of_pixels = colour.reshape(count, samples, width, samples * 3).sum(axis=1)
        folded = rows_of_pixels.reshape(count, width, samples, 3)
        picture[top : top + count] = sum(folded[:, :, k] for k in range(samples)) / samples**2
        depth[top : top + count] = distance[samples // 2 :: samples, samples // 2 :: samples]
    return np.clip(picture, 0, 1), depth


def _screen_rectangle(hull: np.ndarray, xs: np.ndarray, ys: np.ndarray) -> Tuple[int, int, int, int]:
    """Return rows and columns of rays that may meet a surface whose hull, in camera axes, is given."""
    if hull[:, 2].max() < NEAR:
        return 0, 0, 0, 0
    if hull[:, 2].min() < NEAR:
        return 0, len(ys), 0, len(xs)
    x, y = hull[:, 0] / hull[:, 2], hull[:, 1] / hull[:, 2]
    top, bottom = np.searchsorted(ys, [y.min(), y.max()])
    left, right = np.searchsorted(xs, [x.min(), x.max()])
    return int(top), int(bottom), int(left), int(right)


def _render_rows(
    surfaces: Sequence[Any],
    lamp: Lamp,
    rotation: np.ndarray,
    origin: np.ndarray,
    xs: np.ndarray,
    ys: np.ndarray,
    rows: slice,
    rectangles: List[Tuple[int, int, int, int]],
) -> Tuple[np.ndarray, np.ndarray]:
    to_right, to_bottom = np.outer(xs, rotation[0]), np.outer(ys[rows], rotation[1]) + rotation[2]
    directions = to_right.astype(np.float32)[None] + to_bottom.astype(np.float32)[:, None]
    shape = directions.shape[:2]
    distance = np.full(shape, np.inf, np.float32)
    owner = np.full(shape, -1, np.int16)
    u, v = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for index, (surface, (top, bottom, left, right)) in enumerate(zip(surfaces, rectangles)):
        top, bottom = max(top - rows.start, 0), min(bottom - rows.start, shape[0])
        if top >= bottom or left >= right:
            continue
        part = (slice(top, bottom), slice(left, right))
        rays = directions[part]
        hits = surface.intersect(origin, rays.reshape(-1, 3))
        near = hits.distance.reshape(rays.shape[:2]).astype(np.float32)
        closer = near < distance[part]
        for buffer, values in ((distance, near), (u, hits.u), (v, hits.v)):
            np.copyto(buffer[part], values.reshape(closer.shape), where=closer, casting="same_kind")
        owner[part][closer] = index
    distance, owner, u, v = distance.ravel(), owner.ravel(), u.ravel(), v.ravel()
    colour = np.zeros((owner.size, 3), np.float32)
    order = np.argsort(owner, kind="stable")  # a counting sort on int16: groups the rays by surface
    ends = np.searchsorted(owner[order], np.arange(len(surfaces) + 1))
    for index, surface in enumerate(surfaces):
        rays = order[ends[index] : ends[index + 1]]
        if len(rays):
            ray, hits = directions.reshape(-1, 3)[rays], Hits(distance[rays], u[rays], v[rays])
            colour[rays] = surface.shade(hits, origin, ray, lamp)
    return colour.reshape(shape + (3,)), distance.reshape(shape)
