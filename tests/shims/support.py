"""Scenes, cameras and a dense rasterizer for the tests of shims."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_adapters.shims.inria import taming
from legs_adapters.shims.inria.camera import pinhole
from legs_adapters.shims.modules import diff_gaussian_rasterization as inria
from legs_adapters.shims.modules import diff_gaussian_rasterization_fastgs as fastgs

from legs_loss.lab.conventions import NEAR, TILE
from tests.lab import oracle

WIDTH, HEIGHT = 72, 50


BACKGROUND = torch.tensor([0.1, 0.5, 0.9])


def camera(seed=0, width=WIDTH, height=HEIGHT, shift=(0.0, 0.0)):
    """The fields of a view's settings, as Inria's renderer fills them."""
    angle, tanx = 0.1 * seed, 0.8
    tany = tanx * height / width
    rotation = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    world_to_camera = torch.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1], projection[2, 2], projection[2, 3] = 1 / tanx, 1 / tany, 1.0001, -0.01
    projection[0, 2], projection[1, 2], projection[3, 2] = shift[0], shift[1], 1
    view = world_to_camera.T.contiguous()
    return {
        "image_height": height,
        "image_width": width,
        "tanfovx": tanx,
        "tanfovy": tany,
        "bg": BACKGROUND,
        "scale_modifier": 1.0,
        "viewmatrix": view,
        "projmatrix": view @ projection.T,
        "sh_degree": 2,
        "campos": view.inverse()[3, :3],
        "prefiltered": False,
        "debug": False,
    }


def gaussians(count=60, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    means = torch.randn(count, 3, generator=generator) * torch.tensor([1.6, 1.2, 1.0]) + torch.tensor([0, 0, 4.0])
    made = {
        "means3D": means,
        "scales": 0.02 + 0.3 * torch.rand(count, 3, generator=generator),
        "rotations": torch.nn.functional.normalize(torch.randn(count, 4, generator=generator)),
        "opacities": 0.05 + 0.9 * torch.rand(count, 1, generator=generator),
        "shs": 0.4 * torch.randn(count, 9, 3, generator=generator),
    }
    return {name: tensor.to(dtype) for name, tensor in made.items()}


def view_of(fields):
    return pinhole(SimpleNamespace(**fields), "test")


class Dense:
    """The oracle's steps for all pixels at once, with the weight of every splat in every pixel.

    ``inside`` (splats' centres, conics and opacities -> bool [n, tiles down, tiles across]) says which tiles a splat
    is drawn in; by default 3DGS's square.
    """

    def __init__(self, given, fields, inside=None, dtype=torch.float64):
        view = view_of(fields)
        given = {name: tensor.to(dtype) for name, tensor in given.items()}
        to_camera = torch.as_tensor(view.world_to_camera, dtype=dtype)
        points = given["means3D"] @ to_camera[:3, :3].T + to_camera[:3, 3]
        order = torch.sort(points[:, 2].detach().float(), stable=True).indices
        order = order[points[order, 2] > NEAR]
        splats = oracle.project(points[order], given["scales"][order], given["rotations"][order], view)
        offsets = given["means3D"][order] - torch.as_tensor(view.position, dtype=dtype)
        rgb = oracle.colours(torch.nn.functional.normalize(offsets, dim=1), given["shs"][order], fields["sh_degree"])
        ys, xs = torch.meshgrid(torch.arange(view.height), torch.arange(view.width), indexing="ij")
        pixels = torch.stack([xs, ys], 2).reshape(-1, 2)
        opacities = given["opacities"][order, 0]
        if inside is None:
            bounds = oracle.tile_bounds(splats.centres.detach(), splats.radii, view.tiles)
            across, down = torch.arange(view.tiles[0]), torch.arange(view.tiles[1])
            columns = (bounds[:, 0:1] <= across) & (across < bounds[:, 2:3])
            rows = (bounds[:, 1:2] <= down) & (down < bounds[:, 3:4])
            tiles = rows[:, :, None] & columns[:, None] & (splats.radii > 0)[:, None, None]
        else:
            tiles = inside(splats.centres.detach(), splats.conics.detach(), opacities.detach(), view.tiles)
        drawn = tiles[:, pixels[:, 1] // TILE, pixels[:, 0] // TILE].T  # [P, n]
        shown = torch.where(drawn, opacities, torch.zeros_like(opacities))
        one = torch.eye(len(order), dtype=dtype)
        away = splats.centres[None] - pixels[:, None].to(dtype)
        nothing = torch.zeros(len(order), dtype=dtype)
        # Blending the unit vectors gives each splat's weight.
        self.weights = oracle.blend(away, splats.conics, shown, one, nothing)
        colour = self.weights @ rgb + (1 - self.weights.sum(1, keepdim=True)) * fields["bg"].to(dtype)
        self.image = colour.T.reshape(3, view.height, view.width)
        self.order, self.depths, self.away, self.tiles = order, splats.depths, away, tiles
        self.shape = (view.height, view.width)

    def per_gaussian(self, values, count):
        """Sums over the pixels of values [P, n], in the Gaussians' own order."""
        found = torch.zeros(count, dtype=values.dtype)
        found[self.order] = values.sum(0)
        return found


def draw(kind, given, fields, columns=3, **more):
    module = {"inria": inria, "fastgs": fastgs, "taming": taming}[kind]
    settings = module.GaussianRasterizationSettings(**fields, **more)
    means2D = torch.zeros(len(given["means3D"]), columns, requires_grad=True)
    return module.GaussianRasterizer(settings)(means2D=means2D, **given), means2D


def close(found, wanted, tolerance=2e-4):
    scale = max(1e-6, float(wanted.abs().max()))
    assert float((found.detach().double() - wanted.double()).abs().max()) <= tolerance * scale
