"""Scenes of Gaussians, and renderings of them with gradients."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch

from legs_loss.lab import rasterizer
from tests.lab import oracle

NAMES = ("means", "scales", "quaternions", "opacities", "sh", "viewspace")


BACKGROUND = (0.2, 0.5, 0.8)


def camera(width=70, height=45, focal=60.0, cx=None, cy=None):
    turn = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    pose[:3, 3] = 0.1, 0.2, 3.0
    centre = (width / 2 + 1.3 if cx is None else cx, height / 2 - 0.7 if cy is None else cy)
    return SimpleNamespace(
        width=width, height=height, fx=focal, fy=1.05 * focal, cx=centre[0], cy=centre[1], world_to_camera=pose
    )


def scene(count=40, seed=0, spread=1.0, smallest=0.02, largest=0.3, degree=3):
    """Gaussians around the origin, float32: [means, scales, quaternions, opacities, sh]."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    scales = smallest * (largest / smallest) ** torch.rand(count, 3, generator=generator)
    opacities = torch.sigmoid(2 * normal(count, 1))
    return [spread * normal(count, 3), scales, normal(count, 4), opacities, 0.3 * normal(count, (degree + 1) ** 2, 3)]


def run(inputs, view, degree=3, backend="numba", dtype=torch.float32):
    """Rendering, and the gradients of a fixed random weighting of its pixels, by name."""
    leaves = [tensor.detach().to(dtype).requires_grad_() for tensor in inputs]
    leaves.append(torch.zeros(len(leaves[0]), 4, dtype=dtype, requires_grad=True))
    rasterize = oracle.rasterize if backend == "torch" else rasterizer.rasterize
    rendering = rasterize(*leaves[:5], view, BACKGROUND, degree, leaves[5])
    weights = torch.randn(3, view.height, view.width, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    (rendering.image * weights.to(dtype)).sum().backward()
    return rendering, dict(zip(NAMES, (leaf.grad for leaf in leaves)))
