"""Scenes of surfels, and how two rasterizers of them are compared."""

from __future__ import annotations

import math

import torch

from legs_loss.lab.surfels import Surfels, SurfelView, rasterize_surfels
from tests.lab.surfels import oracle

NAMES = ("means", "scales", "quaternions", "opacities", "sh", "viewspace")


BACKGROUND = (0.2, 0.5, 0.8)


DEPTH, ALPHA, NORMAL, MEDIAN, DISTORTION = 0, 1, slice(2, 5), 5, 6


def camera(width=70, height=45, focal=60.0, degree=3, background=BACKGROUND, turn=0.3):
    """A camera, float64, that looks at the origin from three units away."""
    c, s = math.cos(turn), math.sin(turn)
    pose = torch.tensor([[c, 0, s, 0.1], [0, 1, 0, 0.2], [-s, 0, c, 3.0], [0, 0, 0, 1]], dtype=torch.float64)
    across, down = width / (2 * focal), height / (2 * 1.05 * focal)
    near, far = 0.01, 100.0
    projection = torch.zeros(4, 4, dtype=torch.float64)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1 / across, 1 / down, 1
    projection[2, 2], projection[2, 3] = far / (far - near), -far * near / (far - near)
    return SurfelView(
        width=width,
        height=height,
        world_to_camera=pose.T,
        projection=pose.T @ projection.T,
        position=torch.linalg.inv(pose)[:3, 3],
        background=torch.tensor(background, dtype=torch.float64),
        sh_degree=degree,
    )


def in_type(view, dtype):
    return view._replace(
        **{name: value.to(dtype) for name, value in view._asdict().items() if isinstance(value, torch.Tensor)}
    )


def scene(count=40, seed=0, spread=1.0, smallest=0.02, largest=0.3, degree=3):
    """Surfels around the origin, float32: [means, scales, quaternions, opacities, sh]."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    scales = smallest * (largest / smallest) ** torch.rand(count, 2, generator=generator)
    quaternions = torch.nn.functional.normalize(normal(count, 4), dim=1)
    opacities = torch.sigmoid(2 * normal(count, 1))
    return [spread * normal(count, 3), scales, quaternions, opacities, 0.3 * normal(count, (degree + 1) ** 2, 3)]


def rasterize_by(backend, surfels, view):
    """Image, radii, other channels: by the compiled rasterizer ("numba"), or by the oracle ("torch")."""
    if backend == "numba" or not len(surfels.means):
        return rasterize_surfels(surfels, view)
    image, others, radii = oracle.render(surfels, view)
    return image, radii, others


def draw(leaves, viewspace, settings, backend):
    means, scales, quaternions, opacities, sh = leaves
    given = Surfels(means, opacities, scales, quaternions, sh=sh, viewspace=viewspace)
    return rasterize_by(backend, given, settings)


def run(inputs, settings, backend="numba", dtype=torch.float32):
    """Image, radii, other channels; and the gradients of a fixed random weighting of all ten channels, by name."""
    leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in inputs]
    viewspace = torch.zeros(len(leaves[0]), 3, dtype=dtype, requires_grad=True)
    image, radii, others = draw(leaves, viewspace, in_type(settings, dtype), backend)
    if not len(radii):
        return image, radii, others, {name: torch.zeros(0) for name in NAMES}
    both = torch.cat([image, others])
    weights = torch.randn(both.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    (both * weights.to(dtype)).sum().backward()
    return image, radii, others, dict(zip(NAMES, (leaf.grad for leaf in [*leaves, viewspace])))
