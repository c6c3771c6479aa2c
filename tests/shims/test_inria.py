"""The rasterizers of Inria's family against the readable oracle, and their gradients against finite differences."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_adapters.shims.inria.camera import pinhole
from legs_adapters.shims.missing import Absent, MissingShim
from legs_adapters.shims.modules import diff_gaussian_rasterization as inria

from legs_loss import LegsError
from legs_loss.lab.conventions import TILE
from legs_loss.lab.rasterizer import covariance
from tests.shims.support import BACKGROUND, HEIGHT, WIDTH, Dense, camera, close, draw, gaussians


def compact_box(mult):
    """Find the tiles that FastGS draws in: those with a point of the ellipse at ``mult`` times the squared distance."""

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
