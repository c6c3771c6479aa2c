"""Each stand-in against the readable oracle, and its gradients against finite differences."""

from __future__ import annotations

import importlib
import math
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_adapters.shims import finder
from legs_adapters.shims.finder import build, table_for
from legs_adapters.shims.inria import forks, taming
from legs_adapters.shims.inria.camera import pinhole
from legs_adapters.shims.inria.relocation import compute_relocation
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_adapters.shims.inria.survey import Call, Interface
from legs_adapters.shims.missing import Absent, MissingShim
from legs_adapters.shims.modules import diff_gaussian_rasterization as inria
from legs_adapters.shims.modules import diff_gaussian_rasterization_fastgs as fastgs
from legs_adapters.shims.modules import fused_ssim, lpips, simple_knn, torch_scatter, torchvision

from legs_loss import LegsError, ssim
from legs_loss.reference.conventions import NEAR, TILE
from legs_loss.reference.rasterizer import covariance, oracle
from tests.support import ROOT

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


def compact_box(mult):
    """Which tiles FastGS draws in: those that hold a point of the ellipse at ``mult`` times the squared distance."""

    def inside(centres, conics, opacities, tiles):
        found = torch.zeros(len(centres), tiles[1], tiles[0], dtype=torch.bool)
        for i, ((x, y), (a, b, c), opacity) in enumerate(zip(centres.tolist(), conics.tolist(), opacities.tolist())):
            level = mult * 2 * math.log(255 * opacity)
            for row in range(tiles[1]):
                for column in range(tiles[0]):
                    left, top = column * TILE - x, row * TILE - y
                    found[i, row, column] = nearest(a, b, c, left, left + TILE, top, top + TILE) <= level
        return found

    return inside


def nearest(a, b, c, left, right, top, bottom):
    """The least of a x^2 + 2 b x y + c y^2 over a rectangle: 0 if the origin is in it, or else on one of its sides."""
    if left <= 0 <= right and top <= 0 <= bottom:
        return 0.0
    sides = []
    for x in (left, right):
        y = min(max(-b * x / c, top), bottom)
        sides.append(a * x * x + 2 * b * x * y + c * y * y)
    for y in (top, bottom):
        x = min(max(-b * y / a, left), right)
        sides.append(a * x * x + 2 * b * x * y + c * y * y)
    return min(sides)


def draw(kind, given, fields, columns=3, **more):
    module = {"inria": inria, "fastgs": fastgs, "taming": taming}[kind]
    settings = module.GaussianRasterizationSettings(**fields, **more)
    means2D = torch.zeros(len(given["means3D"]), columns, requires_grad=True)
    return module.GaussianRasterizer(settings)(means2D=means2D, **given), means2D


def close(found, wanted, tolerance=2e-4):
    scale = max(1e-6, float(wanted.abs().max()))
    assert float((found.detach().double() - wanted.double()).abs().max()) <= tolerance * scale


class TestImages:
    @pytest.mark.parametrize("seed", range(3))
    def test_inria(self, seed):
        given, fields = gaussians(seed=seed), camera(seed)
        (image, radii), _ = draw("inria", given, fields)
        close(image, Dense(given, fields).image)
        assert radii.dtype == torch.int32
        assert 0 < int((radii > 0).sum()) <= len(radii)

    def test_an_off_centre_camera(self):
        given, fields = gaussians(), camera(shift=(0.2, -0.1))
        found = pinhole(SimpleNamespace(**fields), "test")
        assert found.cx == pytest.approx(1.2 * WIDTH / 2, abs=1e-3)
        close(draw("inria", given, fields)[0][0], Dense(given, fields).image)

    def test_scale_modifier(self):
        given, fields = gaussians(), camera()
        small = dict(given, scales=0.5 * given["scales"])
        (image, _), _ = draw("inria", given, dict(fields, scale_modifier=0.5))
        close(image, Dense(small, fields).image)

    def test_colours_that_are_ready(self):
        given, fields = gaussians(), camera()
        plain = dict(given)
        shs = plain.pop("shs")
        colours = torch.randn(len(shs), 3)  # some below 0, which are not held at it
        settings = inria.GaussianRasterizationSettings(**dict(fields, bg=torch.zeros(3)))
        image, _ = inria.GaussianRasterizer(settings)(means2D=torch.zeros(len(shs), 3), colors_precomp=colours, **plain)
        dense = Dense(given, fields)
        close(image, (dense.weights @ colours[dense.order].double()).T.reshape(image.shape))

    @pytest.mark.parametrize("kind", ["inria", "fastgs"])
    def test_covariances_that_are_ready(self, kind):
        # Against the same shapes as scales and rotations, gradients through the covariances to these included.
        more = {"mult": 0.5, "get_flag": None, "metric_map": None} if kind == "fastgs" else {}
        given, fields = gaussians(), camera()
        given["scales"][:9] *= 0.02  # some that reach no pixel's centre
        weights = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
        found = []
        for ready in (False, True):
            leaves = {name: tensor.clone().requires_grad_() for name, tensor in given.items()}
            asked = dict(leaves)
            if ready:
                matrices = covariance(asked.pop("scales"), asked.pop("rotations"))
                asked["cov3D_precomp"] = matrices.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
            # A modifier of scales is none of covariances.
            results, means2D = draw(kind, asked, dict(fields, scale_modifier=2.0 if ready else 1.0), **more)
            (results[0] * weights).sum().backward()
            found.append((results, {**{name: leaf.grad for name, leaf in leaves.items()}, "means2D": means2D.grad}))
        (plain, wanted), (other, got) = found
        close(other[0], plain[0].detach())
        assert torch.equal(other[1], plain[1])
        for name, gradient in wanted.items():
            assert (got[name] - gradient).norm() < 2e-3 * gradient.norm(), name

    def test_a_matrix_that_is_no_covariance_is_not_drawn(self):
        given, fields = gaussians(20), camera()
        del given["scales"], given["rotations"]
        given["cov3D_precomp"] = torch.tensor([[-1.0, 0, 0, -1.0, 0, 1.0]]).repeat(20, 1)
        (image, radii), _ = draw("inria", given, fields)
        assert not radii.any()
        close(image, BACKGROUND[:, None, None].expand_as(image))

    @pytest.mark.parametrize("mult", [0.3, 0.5, 0.8, 1.0])
    @pytest.mark.parametrize("seed", range(2))
    def test_fastgs_s_compact_box(self, mult, seed):
        given, fields = gaussians(seed=seed), camera(seed)
        fields["sh_degree"] = 1
        metric = (torch.rand(HEIGHT * WIDTH) < 0.3).int()
        split = dict(given, dc=given["shs"][:, :1], shs=given["shs"][:, 1:])
        (image, radii, counts), _ = draw("fastgs", split, fields, 4, mult=mult, get_flag=True, metric_map=metric)
        dense = Dense(given, fields, compact_box(mult))
        close(image, dense.image)
        wanted = dense.per_gaussian((dense.weights > 0) * metric[:, None].double(), len(radii))
        assert torch.equal(counts, wanted.int())
        if mult < 0.6:  # it does cut off something that 3DGS draws
            assert float((dense.image - Dense(given, fields).image).abs().max()) > 1e-3
        seen = torch.zeros(len(radii), dtype=torch.bool)
        seen[dense.order] = dense.tiles.any(2).any(1)
        assert torch.equal(radii > 0, seen)

    def test_fastgs_without_the_flag_counts_nothing(self):
        (_, _, counts), _ = draw("fastgs", gaussians(), camera(), 4, mult=0.5, get_flag=None, metric_map=None)
        assert counts.shape == (0,)

    def test_taming_s_sums(self):
        given, fields = gaussians(), camera()
        pixels = torch.rand(HEIGHT, WIDTH)
        results, _ = draw("taming", given, fields, pixel_weights=pixels)
        dense = Dense(given, fields)
        image, radii, centres, depths = results[0], results[1], results[6], results[7]
        close(image, dense.image)
        drawn = (dense.weights > 0).double()
        close(results[9], dense.per_gaussian(drawn * pixels.reshape(-1, 1), len(radii)))
        assert torch.equal(results[10], dense.per_gaussian(drawn, len(radii)).int())
        close(results[11], dense.per_gaussian(dense.weights, len(radii)))
        close(results[12], dense.per_gaussian(drawn * dense.away.norm(dim=2), len(radii)))
        where = radii[dense.order] > 0
        close(depths[dense.order][where], dense.depths[where])
        assert float(centres[radii == 0].abs().sum()) == 0
        assert isinstance(results[2], Absent)
        without, _ = draw("taming", given, fields, pixel_weights=None)
        assert [without[i].shape for i in range(9, 13)] == [(0,)] * 4


def forked(results, extra=(), **more):
    """Draw with a generic stand-in whose caller unpacks these names."""
    interface = Interface()
    interface.fields = list(extra)
    lines = (forked_call.__code__.co_firstlineno, forked_call.__code__.co_firstlineno + 20)
    interface.calls = [Call(__file__, *lines, tuple(results))]
    module = forks.module("diff_fork", interface)
    given, fields = gaussians(), camera()
    settings = module.GaussianRasterizationSettings(**fields, **more)
    return forked_call(module.GaussianRasterizer(settings), given), Dense(given, fields), given, fields


def forked_call(rasterizer, given, **more):
    return rasterizer(means2D=torch.zeros(len(given["means3D"]), 3, requires_grad=True), **given, **more)


class TestForks:
    def test_names(self):
        names = ("rendered_depth", "acc", "image", "radii", "rendered_invdepth", "pixels", "gs_w", "accum_max_count")
        (depth, alpha, image, radii, inverse, pixels, weights, most), dense, given, _ = forked(names)
        shape = (1, *dense.shape)
        close(image, dense.image)
        close(depth, (dense.weights @ dense.depths).reshape(shape))
        close(inverse, (dense.weights @ (1 / dense.depths)).reshape(shape))
        close(alpha, dense.weights.sum(1).reshape(shape))
        count = len(given["means3D"])
        close(pixels[:, 0], dense.per_gaussian((dense.weights > 0).double(), count))
        close(weights, dense.per_gaussian(dense.weights, count))
        largest = dense.weights.max(1)
        one = torch.nn.functional.one_hot(largest.indices, len(dense.order)) * (largest.values > 0)[:, None]
        assert float((most - dense.per_gaussian(one.double(), count)).abs().max()) <= 2  # ties may go either way
        assert radii.dtype == torch.int32

    def test_inria_s_later_rasterizer_returns_inverse_depth(self):
        (image, _, depth), dense, _, _ = forked(("image", "radii", "depth"), ("antialiasing",), antialiasing=False)
        close(image, dense.image)
        close(depth, (dense.weights @ (1 / dense.depths)).reshape(1, *dense.shape))

    def test_antialiasing_dims_by_as_much_as_the_dilation_widened(self):
        (image, _), _, given, fields = forked(("image", "radii"), ("antialiasing",), antialiasing=True)
        view = view_of(fields)
        to_camera = torch.as_tensor(view.world_to_camera)
        points = given["means3D"].double() @ to_camera[:3, :3].T + to_camera[:3, 3]
        conics = oracle.project(points, given["scales"].double(), given["rotations"].double(), view).conics
        covariance = torch.linalg.inv(torch.stack([conics[:, [0, 1]], conics[:, [1, 2]]], 1))
        before = torch.linalg.det(covariance - 0.3 * torch.eye(2))
        ratio = (before / torch.linalg.det(covariance)).clamp_min(0.000025).sqrt()
        close(image, Dense(dict(given, opacities=given["opacities"] * ratio[:, None]), fields).image, 5e-4)

    def test_the_gradient_of_scores_is_a_sum_of_squares(self):
        # Of one Gaussian, d image / d falloff is its opacity times its colour's distance from the background.
        module, given, fields = forks.module("diff_fork", Interface()), gaussians(1, seed=3), camera()
        scores = torch.zeros(1, 1, requires_grad=True)
        rasterizer = module.GaussianRasterizer(module.GaussianRasterizationSettings(**fields))
        image, _ = forked_call(rasterizer, given, scores=scores)
        weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
        (image * weights).sum().backward()
        dense = Dense(given, fields)
        drawn = (dense.weights[:, 0] > 0).reshape(dense.shape)
        assert drawn.sum() > 50
        at = int(dense.weights.argmax())
        away = (dense.image.reshape(3, -1)[:, at] - BACKGROUND.double()) / dense.weights[at, 0]
        slopes = given["opacities"].double() * (weights.double() * away[:, None, None]).sum(0)
        assert scores.grad.item() == pytest.approx(slopes[drawn].square().sum().item(), rel=1e-3)

    def test_a_gradient_through_depth(self):
        (_, depth, _), dense, given, _ = forked(("image", "rendered_depth", "radii"))
        del dense
        given["means3D"].requires_grad_(True)
        (_, depth, _) = forked(("image", "rendered_depth", "radii"))[0]
        assert depth.requires_grad is False  # nothing that was given asked for one

    @pytest.mark.parametrize(
        ("extra", "more", "named"),
        [
            (("mode",), {"mode": 2}, "GaussianRasterizationSettings(mode=...)"),
            (("confidence",), {"confidence": torch.tensor([1.0, 0.5])}, "GaussianRasterizationSettings(confidence"),
        ],
    )
    def test_settings_that_are_not_known_are_errors(self, extra, more, named):
        with pytest.raises(MissingShim) as caught:
            forked(("image", "radii"), extra, **more)
        assert named in str(caught.value)

    def test_settings_that_change_nothing_are_not(self):
        forked(("image", "radii"), ("mode", "confidence"), mode=None, confidence=torch.ones(3))

    def test_an_unknown_result_is_an_error_where_it_is_used(self):
        (_, _, flow), _, _, _ = forked(("image", "radii", "out_flow"))
        uses = (lambda: flow + 1, lambda: flow.mean(), lambda: flow[0], lambda: torch.mean(flow), lambda: 2 * flow)
        for use in uses:
            with pytest.raises(MissingShim, match="out_flow"):
                use()


class Distance(torch.nn.Module):
    def __init__(self, power, scale):
        super().__init__()
        self.power, self.scale = power, scale

    def forward(self, x, y):
        return self.scale * (x - y).abs().pow(self.power).mean((1, 2, 3))


def loss_of(image):
    generator = torch.Generator().manual_seed(5)
    weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    return (image.double() * weights).sum()


def difference(function, tensor, index, step=1e-6):
    """The central difference of ``function``, in float64."""
    moved = []
    for sign in (1, -1):
        changed = tensor.clone()
        changed[index] += sign * step
        moved.append(float(function(changed)))
    return (moved[0] - moved[1]) / (2 * step)


class TestGradients:
    """The hard cuts are not differentiable: where a difference steps over one, it is not the derivative.

    Of the 24 numbers that each test moves by 1e-6, chance seldom takes one over a cut; the tests below the first show
    what happens there.
    """

    @pytest.mark.parametrize("kind", ["inria", "fastgs", "taming"])
    @pytest.mark.parametrize("name", ["means3D", "scales", "rotations", "opacities", "shs"])
    def test_finite_differences(self, kind, name):
        given, fields = gaussians(24, seed=3), camera()
        more = {
            "inria": {},
            "fastgs": {"mult": 0.5, "get_flag": None, "metric_map": None},
            "taming": {"pixel_weights": None},
        }[kind]
        given["opacities"].clamp_(max=0.9)  # below the ceiling
        leaf = given[name].requires_grad_(True)
        results, _ = draw(kind, given, fields, 4 if kind == "fastgs" else 3, **more)
        loss_of(results[0]).backward()
        found = leaf.grad.double()
        exact = {key: tensor.detach().double() for key, tensor in given.items()}
        inside = compact_box(0.5) if kind == "fastgs" else None
        generator = torch.Generator().manual_seed(1)
        wrong = 0
        for _ in range(24):
            index = tuple(int(torch.randint(0, size, (1,), generator=generator)) for size in leaf.shape)

            def value(changed):
                with torch.no_grad():
                    return loss_of(Dense(dict(exact, **{name: changed}), fields, inside).image)

            wanted = difference(value, exact[name], index)
            wrong += abs(wanted - float(found[index])) > 1e-3 * float(found.abs().max())
        assert wrong <= 1

    def one(self, opacity):
        """A single Gaussian in the middle of the image, gray on black, and a loss that looks at one pixel."""
        fields = camera(width=73, height=51)  # the middle is a pixel's centre
        fields["projmatrix"] = fields["viewmatrix"].inverse() @ fields["projmatrix"]
        fields.update(viewmatrix=torch.eye(4), campos=torch.zeros(3), bg=torch.zeros(3), sh_degree=0)
        given = {
            "means3D": torch.tensor([[0.0, 0.0, 4.0]]),
            "scales": torch.full((1, 3), 0.3),
            "rotations": torch.tensor([[1.0, 0, 0, 0]]),
            "opacities": torch.tensor([[opacity]]),
            "shs": torch.full((1, 1, 3), 1.0),
        }
        return given, fields

    def test_at_the_ceiling_the_gradient_passes_as_upstream_s_does(self):
        given, fields = self.one(1.0)
        given["opacities"].requires_grad_(True)
        (image, _), _ = draw("inria", given, fields)
        peak = int(image[0].argmax())
        image[0].reshape(-1)[peak].backward()
        exact = {name: tensor.detach() for name, tensor in given.items()}

        def value(changed):
            return Dense(dict(exact, opacities=changed), fields).image[0].reshape(-1)[peak]

        # Alpha is held at 0.99, so the picture does not change; 3DGS's gradient is that of the alpha before the hold.
        assert difference(value, exact["opacities"].double(), (0, 0)) == 0
        free, _ = self.one(0.9)
        free["opacities"].requires_grad_(True)
        (below, _), _ = draw("inria", free, fields)
        below[0].reshape(-1)[peak].backward()
        assert float(given["opacities"].grad) == pytest.approx(float(free["opacities"].grad), rel=1e-4)
        assert float(given["opacities"].grad) > 0.1

    def test_at_the_threshold_the_picture_jumps_and_the_gradient_does_not(self):
        given, fields = self.one(0.5)
        dense = Dense(given, fields)
        alpha = dense.weights[:, 0]
        edge = int(torch.where(alpha > 0, alpha, torch.ones_like(alpha)).argmin())
        # The opacity at which this pixel's alpha is exactly 1/255.
        opacity = 0.5 * (1 / 255) / float(alpha[edge])
        pictures = [Dense(dict(given, opacities=torch.tensor([[opacity * f]])), fields).image for f in (0.9999, 1.0001)]
        jump = (pictures[1] - pictures[0])[0].reshape(-1)[edge]
        colour = float(dense.image[0].max() / dense.weights.max())
        assert float(jump) == pytest.approx(colour / 255, rel=1e-2)
        slopes = []
        for factor in (0.9999, 1.0001):
            near = dict(given, opacities=torch.tensor([[opacity * factor]], requires_grad=True))
            (image, _), _ = draw("inria", near, fields)
            image[0].reshape(-1)[edge].backward()
            slopes.append(float(near["opacities"].grad))
        # Below it none, above it that of a smooth splat: the jump itself, 1/255 over an infinitely small step, is in
        # neither, and a difference that steps over it is off by (colour / 255) / (2 step).
        assert slopes[0] == 0
        assert slopes[1] == pytest.approx(colour / 255 / opacity, rel=1e-2)

    @pytest.mark.parametrize(("kind", "columns"), [("inria", 3), ("taming", 3), ("fastgs", 4)])
    def test_the_view_space_gradient_is_in_half_images(self, kind, columns):
        given, fields = gaussians(24), camera()
        more = {"inria": {}, "taming": {"pixel_weights": None}, "fastgs": {"mult": 9.0}}[kind]
        if kind == "fastgs":
            more.update(get_flag=None, metric_map=None)
        results, means2D = draw(kind, given, fields, columns, **more)
        loss_of(results[0]).backward()
        # Moving every centre by d pixels is moving the principal point.
        found = means2D.grad.double().sum(0)
        shapes = {"inside": compact_box(9.0)} if kind == "fastgs" else {}

        def value(shift):
            # 3DGS's colours depend on the direction, which stays, and the shapes on the position before the lens.
            moved = camera(shift=tuple(2 * shift.numpy() / (WIDTH, HEIGHT)))
            return loss_of(Dense(given, moved, **shapes).image)

        wanted = [difference(value, torch.zeros(2, dtype=torch.float64), (i,), 1e-4) for i in range(2)]
        assert float(found[0]) == pytest.approx(wanted[0] * WIDTH / 2, rel=2e-2, abs=1.0)
        assert float(found[1]) == pytest.approx(wanted[1] * HEIGHT / 2, rel=2e-2, abs=1.0)
        if columns == 3:
            assert float(found[2]) == 0
        else:
            assert bool((means2D.grad[:, 2:] >= means2D.grad[:, :2].abs() * (1 - 1e-4) - 1e-6).all())


class TestErrors:
    def test_a_camera_that_is_no_pinhole(self):
        fields = camera()
        fields["projmatrix"] = torch.eye(4)
        with pytest.raises(MissingShim, match=r"GaussianRasterizer.*pinhole"):
            draw("inria", gaussians(), fields)

    def test_a_centre_that_is_not_the_view_s(self):
        with pytest.raises(MissingShim, match="campos"):
            draw("inria", gaussians(), dict(camera(), campos=torch.ones(3)))

    def test_shapes_given_twice(self):
        with pytest.raises(LegsError, match="either scales and rotations or cov3D_precomp"):
            draw("inria", dict(gaussians(), cov3D_precomp=torch.ones(60, 6)), camera())

    def test_values_that_are_not_finite(self):
        given = gaussians()
        given["scales"][3, 1] = float("nan")
        with pytest.raises(LegsError, match="scales"):
            draw("inria", given, camera())

    def test_two_ways_at_once(self):
        with pytest.raises(LegsError, match="either shs or colors_precomp"):
            draw("inria", dict(gaussians(), colors_precomp=torch.ones(60, 3)), camera())


class TestOthers:
    def test_mark_visible(self):
        fields = camera()
        rasterizer = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**fields))
        points = torch.tensor([[0.0, 0, 4], [0, 0, -4], [0, 0, 0.1 - 0.3]])
        assert rasterizer.markVisible(points).tolist() == [True, False, False]

    @pytest.mark.parametrize("modifier", [1.0, 2.5])
    def test_the_visible_filter_is_the_radii_of_drawing(self, modifier):
        given, fields = gaussians(200, seed=2), dict(camera(), scale_modifier=modifier)
        given["means3D"][::2, 0] += 8  # out of sight, but for the largest
        (_, radii), _ = draw("inria", given, fields)
        rasterizer = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(**fields))
        found = rasterizer.visible_filter(given["means3D"], given["scales"], given["rotations"])
        assert torch.equal(found, radii)
        assert 0 < int((found > 0).sum()) < 200

    def test_what_a_fork_s_rasterizer_has_more_is_an_error_that_names_it(self):
        rasterizer = forks.module("diff_fork", Interface()).GaussianRasterizer(None)
        with pytest.raises(MissingShim, match=r"diff_fork\.GaussianRasterizer\.integrate has no stand-in"):
            rasterizer.integrate(torch.ones(3))
        assert not hasattr(rasterizer, "_private")

    @pytest.mark.parametrize("dim", [0, 1, -1])
    def test_scattering(self, dim):
        generator = torch.Generator().manual_seed(0)
        src = torch.randn(7, 6, 5, generator=generator, dtype=torch.float64, requires_grad=True)
        index = torch.randint(0, 4, (src.shape[dim],), generator=generator)
        index[index == 2] = 3  # nothing has 2
        shown = src.detach().transpose(0, dim)
        groups = [shown[index == k] for k in range(6)]
        results = {
            torch_scatter.scatter_sum: [group.sum(0) for group in groups],
            torch_scatter.scatter_add: [group.sum(0) for group in groups],
            torch_scatter.scatter_mean: [group.sum(0) / max(1, len(group)) for group in groups],
        }
        for function, wanted in results.items():
            close(function(src, index, dim, dim_size=6), torch.stack(wanted).transpose(0, dim), 1e-12)
        assert torch_scatter.scatter_sum(src, index, dim).shape[dim] == 4
        found, where = torch_scatter.scatter_max(src, index, dim, dim_size=6)
        found, where = found.transpose(0, dim), where.transpose(0, dim)
        for k, group in enumerate(groups):
            assert torch.equal(found[k].detach(), group.max(0).values if len(group) else torch.zeros_like(shown[0]))
            assert torch.equal(index[where[k][where[k] < len(index)]].unique(), index[index == k].unique())
        found.sum().backward()
        assert int(src.grad.sum()) == sum(len(group) > 0 for group in groups) * shown[0].numel()

    def test_scattering_takes_the_first_of_equal_ones_and_an_index_for_each(self):
        src = torch.tensor([[2.0, 1.0], [2.0, 5.0], [0.0, 5.0]], requires_grad=True)
        found, where = torch_scatter.scatter_max(src, torch.tensor([[0, 1], [0, 1], [0, 0]]), 0)
        assert found.tolist() == [[2, 5], [0, 5]]
        assert where.tolist() == [[0, 2], [3, 1]]
        found.sum().backward()
        assert src.grad.tolist() == [[1, 0], [0, 1], [0, 1]]
        assert torch_scatter.scatter_mean(torch.tensor([3, 4]), torch.tensor([0, 0])).tolist() == [3]
        with pytest.raises(MissingShim, match=r"torch_scatter\.scatter_sum\(out"):
            torch_scatter.scatter_sum(src, torch.zeros(3, dtype=torch.int64), 0, torch.zeros(1, 2))
        with pytest.raises(MissingShim, match=r"torch_scatter\.segment_csr"):
            torch_scatter.module("torch_scatter", Interface()).segment_csr(src, src)

    @pytest.mark.parametrize("count", [4, 50])
    def test_nearest_neighbours(self, count):
        points = torch.rand(count, 3)
        squares = torch.cdist(points.double(), points.double()).square()
        squares.fill_diagonal_(float("inf"))
        close(simple_knn.distCUDA2(points), squares.topk(3, largest=False).values.mean(1), 1e-5)

    def test_copies_of_a_point_are_its_neighbours(self):
        points = torch.cat([torch.zeros(4, 3), torch.ones(1, 3)])
        assert simple_knn.distCUDA2(points).tolist() == [0, 0, 0, 0, 3]

    @pytest.mark.parametrize(("padding", "ours"), [("same", "zeros"), ("valid", "valid")])
    def test_fused_ssim(self, padding, ours):
        first, second = torch.rand(2, 1, 3, 30, 40).unbind(0)
        first.requires_grad_(True)
        found = fused_ssim.fused_ssim(first, second, padding)
        found.backward()
        gradient, first.grad = first.grad, None
        wanted = ssim(first, second, ours)
        wanted.backward()
        assert found.item() == pytest.approx(wanted.item(), abs=1e-5)
        close(gradient, first.grad, 1e-3)

    def test_sparse_adam_moves_what_is_visible(self):
        parameter = torch.nn.Parameter(torch.ones(4, 2))
        optimizer = SparseGaussianAdam([{"params": [parameter], "lr": 0.1}], lr=0.0, eps=1e-15)
        visible = torch.tensor([True, False, True, False])
        values, first, second = np.ones((4, 2)), np.zeros((4, 2)), np.zeros((4, 2))
        for step in range(3):
            gradient = np.random.RandomState(step).randn(4, 2)
            parameter.grad = torch.tensor(gradient, dtype=torch.float32)
            optimizer.step(visible, 4)
            shown = visible.numpy()
            first[shown] = 0.9 * first[shown] + 0.1 * gradient[shown]
            second[shown] = 0.999 * second[shown] + 0.001 * gradient[shown] ** 2
            values[shown] -= 0.1 * first[shown] / (np.sqrt(second[shown]) + 1e-15)
        close(parameter.detach(), torch.tensor(values), 1e-5)

    def test_relocation(self):
        binoms = torch.tensor([[1, 0, 0], [1, 1, 0], [1, 2, 1]]).float()
        opacity, scale = torch.tensor([0.5, 0.5]), torch.ones(2, 3)
        new, scales = compute_relocation(opacity, scale, torch.tensor([1, 3]), binoms, 3)
        assert new.tolist() == pytest.approx([0.5, 1 - 0.5 ** (1 / 3)])
        # Along a ray through the middle, three in one place let through what the one did; and their integral stays.
        assert scales[0].tolist() == pytest.approx([1, 1, 1])
        grid = torch.linspace(-8, 8, 2001)
        blended = 1 - (1 - new[1] * torch.exp(-0.5 * (grid / scales[1, 0]) ** 2)) ** 3
        assert float(blended.sum()) == pytest.approx(float((0.5 * torch.exp(-0.5 * grid**2)).sum()), rel=1e-3)

    def test_pictures(self, tmp_path):
        image = torch.rand(3, 5, 7)
        torchvision.save_image(image, tmp_path / "a.png")
        again = torchvision.read_image(tmp_path / "a.png")
        close(again / 255, image, 1 / 255)
        assert torch.equal(torchvision.to_tensor(torchvision.to_pil_image(again)), again / 255)
        grid = torchvision.make_grid([image, image, image], nrow=2)
        assert grid.shape == (3, 2 * 7 + 2, 2 * 9 + 2)
        assert torch.equal(grid[:, 2:7, 2:9], image)
        assert torchvision.resize(image, [10, 14]).shape == (3, 10, 14)

    def test_what_torchvision_s_stand_in_lacks_can_be_imported_and_not_used(self):
        module = torchvision.module("torchvision", Interface())
        network = module.models.resnet50
        with pytest.raises(MissingShim, match=r"torchvision\.models\.resnet50"):
            network()

    def test_lpips_is_nan_and_says_so_once(self, capsys, monkeypatch):
        monkeypatch.setattr(lpips, "_said", False)
        monkeypatch.setattr(lpips, "_real", lambda name: (_ for _ in ()).throw(OSError("no network")))
        module = lpips.module("lpipsPyTorch", Interface())
        image = torch.rand(1, 3, 8, 8)
        assert torch.isnan(module.lpips(image, image)).all()
        assert torch.isnan(module.LPIPS("vgg")(image, image)).all()
        assert capsys.readouterr().err.count("LPIPS is NaN") == 1

    def test_lpips_is_the_real_one_where_it_can_be_had(self):
        network = lpips._network(lambda power, scale=1: Distance(power, scale))(2, scale=3)
        assert network(torch.ones(2, 3, 4, 4), torch.zeros(2, 3, 4, 4)).tolist() == [3, 3]

    def test_every_shim_can_be_built_under_its_name(self):
        for name, shim in table_for().items():
            assert build(name, shim).__name__ == name
        for name in finder.AMENDED.values():
            assert importlib.import_module(f"legs_adapters.shims.modules.{name}").amend

    def test_the_recipe_in_contributing_is_one_file(self, tmp_path, monkeypatch):
        text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
        (code,) = re.findall(r"```python\n(\"\"\"diff_gaussian_rasterization_foo.*?)```", text, re.S)
        (tmp_path / "diff_gaussian_rasterization_foo.py").write_text(code)
        monkeypatch.setattr(finder.modules, "__path__", [*finder.modules.__path__, str(tmp_path)])
        monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))
        finder.install()
        from diff_gaussian_rasterization_foo import GaussianRasterizationSettings, GaussianRasterizer

        given, fields = gaussians(), camera()
        rasterizer = GaussianRasterizer(GaussianRasterizationSettings(**fields, gamma=2.0))
        image, _, depth = rasterizer(means2D=torch.zeros(60, 3), **given)
        dense = Dense(given, fields)
        close(image, dense.image)
        close(depth, (dense.weights @ dense.depths).reshape(1, *dense.shape))
        with pytest.raises(
            MissingShim, match=r"diff_gaussian_rasterization_foo.GaussianRasterizer.forward\(gain=...\)"
        ):
            rasterizer(means2D=torch.zeros(60, 3), gain=1.0, **given)
        with pytest.raises(MissingShim, match=r"diff_gaussian_rasterization_foo.unlisted"):
            from diff_gaussian_rasterization_foo import unlisted  # noqa: F401

    def test_a_fork_s_own_rasterizer_is_not_inria_s(self):
        plain, more, scored = Interface(), Interface(), Interface()
        plain.calls = [Call("a.py", 1, 2, ("image", "radii"))]
        more.calls = [Call("a.py", 1, 2, ("image", "radii", "depth"))]
        scored.fields = ["pixel_weights"]
        name = "diff_gaussian_rasterization"
        for interface, home in ((plain, inria), (more, forks), (scored, taming)):
            table = table_for({name: interface, "diff_other": interface})
            assert build(name, table[name]).__doc__ == home.__doc__
            assert build("diff_other", table["diff_other"]).__doc__ == forks.__doc__
