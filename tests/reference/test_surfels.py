"""Surfels: the oracle against geometry and derivatives, the compiled rasterizer against the oracle, the shim."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from legs_adapters.shims.finder import build, table_for
from legs_adapters.shims.missing import MissingShim

from legs_loss import LegsError
from legs_loss.reference.conventions import MAX_ALPHA, MIN_ALPHA
from legs_loss.reference.rasterizer import oracle
from legs_loss.reference.surfels import Surfels, SurfelView, rasterize_surfels
from legs_loss.reference.surfels import oracle as surfels_oracle

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


def draw(leaves, viewspace, settings, backend):
    means, scales, quaternions, opacities, sh = leaves
    given = Surfels(means, opacities, scales, quaternions, sh=sh, viewspace=viewspace)
    return rasterize_surfels(given, settings, backend)


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


def assert_close_gradients(got, wanted, tolerance, names=NAMES):
    for name in names:
        g, w = got[name].double(), wanted[name]
        size = w.norm()
        if size < 1e-12:
            assert g.norm() < 1e-12, name
        else:
            assert (g - w).norm() < tolerance * size, name
            assert (g * w).sum() > 0.9999 * g.norm() * size, name


def assert_agree(inputs, settings, tolerance=1e-4):
    image, radii, others, gradients = run(inputs, settings)
    expected, expected_radii, expected_others, expected_gradients = run(inputs, settings, "torch", torch.float64)
    assert image.dtype == others.dtype == torch.float32
    assert torch.equal(radii, expected_radii)
    torch.testing.assert_close(image.double(), expected, atol=tolerance, rtol=0)
    for channel, wanted in zip(others.double(), expected_others):
        assert (channel - wanted).abs().max() <= tolerance * wanted.abs().max().clamp_min(1e-3)
    assert_close_gradients(gradients, expected_gradients, tolerance)
    return image, radii, others


class TestAgreement:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_every_degree(self, degree):
        assert_agree(scene(degree=3), camera(degree=degree))

    def test_a_crowd(self):
        _, radii, _ = assert_agree(scene(800), camera(100, 83))
        assert (radii > 0).sum() > 500

    @pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (17, 1), (7, 33), (33, 65), (16, 32)])
    def test_odd_sizes(self, width, height):
        assert_agree(scene(60), camera(width, height, focal=20.0))

    def test_none(self):
        image, radii, others = assert_agree(scene(0), camera())
        assert not image.any() and not others.any() and len(radii) == 0  # as upstream: not even the background

    def test_one(self):
        inputs = scene(1)
        inputs[0] = torch.zeros(1, 3)
        assert (assert_agree(inputs, camera())[1] > 0).all()

    def test_all_behind_the_camera(self):
        inputs = scene()
        inputs[0] -= torch.tensor([0.0, 0.0, 30.0])
        image, radii, _ = assert_agree(inputs, camera())
        assert (radii == 0).all()
        torch.testing.assert_close(image, torch.tensor(BACKGROUND)[:, None, None].expand_as(image))

    def test_some_around_the_camera(self):
        _, radii, _ = assert_agree(scene(200, spread=3.0), camera())
        assert (radii == 0).any() and (radii > 45).any()

    def test_giants(self):
        # Discs that reach behind the camera: the ray's meeting point is masked where it lies there.
        assert_agree(scene(20, smallest=5.0, largest=500.0), camera())

    def test_thin(self):
        # A fiftieth of a pixel across: where the two falloffs meet, rounding decides which a pixel takes.
        inputs = scene(50, seed=2)
        inputs[1] = torch.tensor([[1.0, 1e-3]]).repeat(50, 1)
        assert_agree(inputs, camera(), tolerance=1e-3)

    def test_dust(self):
        assert_agree(scene(60, smallest=1e-5, largest=1e-3), camera())

    def test_seen_from_their_edge(self):
        # Normals within half a degree of the image plane: the ray meets them almost nowhere.
        inputs = scene(40, seed=3)
        inputs[0] *= 0.5
        to_world = np.linalg.inv(camera().world_to_camera.T[:3, :3].numpy())
        position = camera().position.numpy()
        quaternions = []
        for index, mean in enumerate(inputs[0].double().numpy()):
            ray = mean - position
            ray /= np.linalg.norm(ray)
            side = np.cross(ray, to_world[:, index % 2])
            normal = side / np.linalg.norm(side) + 0.004 * ray
            quaternions.append(_turn_to(normal / np.linalg.norm(normal)))
        inputs[2] = torch.tensor(np.array(quaternions), dtype=torch.float32)
        assert_agree(inputs, camera(), tolerance=1e-3)

    def test_opaque_layers(self):
        # The transmittance falls below its least value; median depth, distortion and the ceiling of alpha all matter.
        inputs = scene(60, smallest=0.5, largest=1.0)
        inputs[3] = torch.full_like(inputs[3], 0.999)
        assert_agree(inputs, camera(), tolerance=1e-3)

    def test_faint(self):
        inputs = scene()
        inputs[3] = torch.full_like(inputs[3], 0.003)
        _, radii, others = assert_agree(inputs, camera())
        assert (radii > 0).any() and not others.any()

    def test_undefined_gradients_where_nothing_is_drawn(self):
        # 2DGS divides depth by alpha: where that is zero its gradient is NaN, and belongs to no surfel.
        inputs, settings = scene(10, spread=0.5), in_type(camera(), torch.float32)
        results = []
        for undefined in (0.0, math.nan):
            leaves = [tensor.clone().requires_grad_() for tensor in inputs]
            image, _, others = draw(leaves, None, settings, "numba")
            empty = others.detach()[ALPHA] == 0
            assert empty.any() and not empty.all()
            gradient = torch.where(empty, torch.tensor(undefined), torch.tensor(1.0))
            torch.autograd.backward([image, others], [gradient.expand_as(image), gradient.expand_as(others)])
            results.append([leaf.grad for leaf in leaves])
        for expected, got in zip(*results):
            assert torch.equal(got, expected)

    def test_colours_handed_in(self):
        means, scales, quaternions, opacities, _ = scene()
        rgb = torch.rand(len(means), 3, generator=torch.Generator().manual_seed(1))
        results = []
        for backend, dtype in (("numba", torch.float32), ("torch", torch.float64)):
            colours = rgb.clone().to(dtype).requires_grad_()
            geometry = [tensor.to(dtype) for tensor in (means, opacities, scales, quaternions)]
            image, _, _ = rasterize_surfels(Surfels(*geometry, colours=colours), in_type(camera(), dtype), backend)
            image.square().sum().backward()
            results.append((image.double(), colours.grad.double()))
        torch.testing.assert_close(*[image for image, _ in results], atol=1e-5, rtol=0)
        torch.testing.assert_close(*[gradient for _, gradient in results], atol=1e-4, rtol=1e-4)

    def test_homographies_handed_in(self):
        means, scales, quaternions, opacities, sh = scene(30, smallest=0.005)
        settings = camera()
        rows = surfels_oracle.homographies(
            *[tensor.double() for tensor in (means, scales, quaternions)], settings.projection, 70, 45
        ).reshape(-1, 9)
        weights = torch.randn(10, 45, 70, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        weights[2:5] = 0  # of the other channels, normals are not defined by a homography
        results = []
        for backend, dtype in (("numba", torch.float32), ("torch", torch.float64)):
            given = rows.to(dtype).requires_grad_()
            viewspace = torch.zeros_like(means, dtype=dtype, requires_grad=True)
            handed = Surfels(
                means.to(dtype), opacities.to(dtype), homographies=given, sh=sh.to(dtype), viewspace=viewspace
            )
            image, _, others = rasterize_surfels(handed, in_type(settings, dtype), backend)
            (torch.cat([image, others]) * weights.to(dtype)).sum().backward()
            results.append((image, {"rows": given.grad, "viewspace": viewspace.grad}))
        torch.testing.assert_close(results[0][0].double(), results[1][0], atol=1e-5, rtol=0)
        assert_close_gradients(results[0][1], results[1][1], 1e-3, ("rows", "viewspace"))
        expected, _, _, _ = run([means, scales, quaternions, opacities, sh], settings, "torch", torch.float64)
        torch.testing.assert_close(results[1][0], expected)

    def test_a_ray_along_the_disc(self):
        # At the column 31, p_z is 0 to the last bit; right of it the disc comes nearer, left of it it is behind.
        rows = torch.tensor([[15.5, 0.0, 128.0, 0.0, 8.0, 88.0, 0.5, 0.0, 4.0]])
        means, _, _, _, sh = scene(1)
        results = []
        for backend, dtype in (("numba", torch.float32), ("torch", torch.float64)):
            given = rows.detach().to(dtype, copy=True).requires_grad_()
            opacity = torch.full((1, 1), 0.9, dtype=dtype)
            handed = Surfels(0 * means.to(dtype), opacity, homographies=given, sh=sh.to(dtype))
            image, _, others = rasterize_surfels(handed, in_type(camera(), dtype), backend)
            (image.sum() + others[:2].sum() + others[5:].sum()).backward()
            results.append((torch.cat([image, others[:2], others[5:]]).double(), given.grad.double()))
        (got, gradient), (expected, expected_gradient) = results
        assert not got[3 + ALPHA, :, :32].any() and got[3 + ALPHA, :, 32].any()
        torch.testing.assert_close(got, expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(gradient, expected_gradient, atol=1e-4, rtol=1e-4)


def _turn_to(normal):
    """wxyz of the shortest turn from the z axis."""
    w = 1 + normal[2]
    quaternion = np.array([w, -normal[1], normal[0], 0.0]) if w > 1e-6 else np.array([0.0, 1, 0, 0])
    return quaternion / np.linalg.norm(quaternion)


def plane(tilt=0.0, opacity=0.8, size=0.7, dtype=torch.float64):
    """One disc at the origin, turned about its vertical axis from facing along z."""
    quaternion = [math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0]
    values = [[[0.0, 0.0, 0.0]], [[size, size]], [quaternion], [[opacity]], [[[1.0, 0.5, 0.25]]]]
    return [torch.tensor(value, dtype=dtype) for value in values]


class TestGeometry:
    """The oracle against a ray and a plane written down by hand."""

    @pytest.mark.parametrize("tilt", [0.0, 0.7, -1.2])
    def test_depth_is_where_the_ray_meets_the_plane(self, tilt):
        settings = camera(degree=0)
        image, _, others = draw(plane(tilt), None, settings, "torch")
        pose = settings.world_to_camera.T.numpy()
        centre = pose[:3, 3]
        turned = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
        first, second, normal = (pose[:3, :3] @ turned).T
        for row, column in ((22, 36), (30, 40), (15, 30)):
            ray = np.array([(column + 0.5 - 35) / 60, (row + 0.5 - 22.5) / 63, 1.0])
            depth = centre @ normal / (ray @ normal)
            offset = depth * ray - centre
            alpha = 0.8 * math.exp(-0.5 * ((offset @ first / 0.7) ** 2 + (offset @ second / 0.7) ** 2))
            assert others[ALPHA, row, column].item() == pytest.approx(alpha, rel=1e-9)
            assert others[DEPTH, row, column].item() == pytest.approx(alpha * depth, rel=1e-9)
            assert others[MEDIAN, row, column].item() == pytest.approx(depth, rel=1e-9)
            towards = -math.copysign(1, centre @ normal) * normal
            np.testing.assert_allclose(others[NORMAL, row, column].numpy(), alpha * towards, rtol=1e-9)
            red = alpha * (0.5 + 0.28209479177387814) + (1 - alpha) * BACKGROUND[0]
            assert image[0, row, column].item() == pytest.approx(red, rel=1e-9)

    def test_distortion_is_the_weighted_spread_of_depths(self):
        both = [torch.cat(pair) for pair in zip(plane(), plane(0.3))]
        both[0][1] = torch.tensor([0.1, 0.0, 1.0])
        settings = camera(degree=0)
        _, _, near = draw(plane(), None, settings, "torch")
        _, _, others = draw(both, None, settings, "torch")
        alone = [tensor[1:] for tensor in both]
        _, _, far = draw(alone, None, settings, "torch")
        row, column = 22, 36
        depths = [part[DEPTH, row, column] / part[ALPHA, row, column] for part in (near, far)]
        m = [100 / 99.8 * (1 - 0.2 / depth) for depth in depths]
        first = near[ALPHA, row, column]
        second = (1 - first) * far[ALPHA, row, column]
        torch.testing.assert_close(
            others[DISTORTION, row, column], first * second * (m[0] - m[1]) ** 2, rtol=1e-5, atol=0
        )

    def test_a_dot_is_a_pixel_wide(self):
        _, radii, others = draw(plane(size=1e-6), None, camera(degree=0), "torch")
        assert radii.item() == 3  # 3 / sqrt(2), rounded up
        assert others[ALPHA].max() > 0.3
        assert 0 < (others[ALPHA] > 0).sum() < 30


class TestDerivatives:
    def test_the_oracle_on_discs(self):
        # Large discs: every ray's falloff is the disc's own, so all ten channels are differentiable.
        inputs = scene(4, seed=2, spread=0.2, smallest=1.0, largest=2.0, degree=1)
        inputs[2] = torch.tensor([[1.0, 0.1, 0.2, 0.3], [1, -0.3, 0.1, 0], [1, 0.2, -0.2, 0.1], [1, 0, 0.3, -0.1]])
        inputs[3] = torch.tensor([[0.3], [0.5], [0.4], [0.6]])
        self._gradcheck(inputs, camera(6, 5, focal=20.0, degree=1), slice(None))

    def test_the_oracle_on_dots(self):
        # All falloffs are the screen's. Depths' gradient leaves out (u, v) there, as upstream's: not checked.
        inputs = scene(4, seed=2, spread=0.1, smallest=1e-4, largest=2e-4, degree=1)
        inputs[3] = torch.tensor([[0.3], [0.5], [0.4], [0.6]])
        self._gradcheck(inputs, camera(6, 5, focal=20.0, degree=1), [0, 1, 2, 4, 5, 6, 7])

    @staticmethod
    def _gradcheck(inputs, settings, channels):
        def function(means, scales, quaternions, opacities, sh):
            unit = torch.nn.functional.normalize(quaternions, dim=1)
            image, _, others = draw((means, scales, unit, opacities, sh), None, settings, "torch")
            assert others[ALPHA].max() > 0.2
            return torch.cat([image, others])[channels]

        leaves = [tensor.double().requires_grad_() for tensor in inputs]
        assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-5, rtol=1e-4)

    @pytest.mark.parametrize("index", range(5), ids=NAMES[:5])
    def test_the_compiled_one_along_random_directions(self, index):
        # Seen from near their middles: no pixel is near a cut, and every falloff is a disc's.
        inputs = scene(5, seed=4, spread=0.1, smallest=0.6, largest=0.8, degree=1)
        inputs[2] = torch.nn.functional.normalize(torch.tensor([1.0, 0, 0, 0]) + 0.1 * inputs[2], dim=1)
        inputs[3] = 0.2 + 0.1 * inputs[3]
        settings = in_type(camera(9, 8, focal=60.0, degree=1), torch.float32)
        weights = torch.randn(10, 8, 9, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        direction = torch.randn(inputs[index].shape, generator=torch.Generator().manual_seed(6))

        def loss(step):
            moved = list(inputs)
            moved[index] = inputs[index] + step * direction
            moved[2] = torch.nn.functional.normalize(moved[2], dim=1)
            image, _, others = draw(moved, None, settings, "numba")
            return (torch.cat([image, others]).double() * weights).sum()

        step = torch.zeros((), requires_grad=True)
        loss(step).backward()
        numeric = (loss(3e-3) - loss(-3e-3)) / 6e-3
        assert abs(numeric) > 0.1
        assert step.grad.item() == pytest.approx(numeric.item(), rel=1e-2, abs=1e-3)

    def test_the_view_space_gradient(self):
        # Of the homogeneous pixel coordinates of the centre, times depth and half the image's size.
        inputs = [tensor.double() for tensor in scene(6, seed=1, smallest=0.2)]
        settings = camera()
        _, _, _, gradients = run(inputs, settings, "torch", torch.float64)
        rows = surfels_oracle.homographies(*inputs[:3], settings.projection, 70, 45).requires_grad_()
        normals = surfels_oracle.axes(inputs[2])[2] @ settings.world_to_camera[:3, :3]
        points = inputs[0] @ settings.world_to_camera[:3, :3] + settings.world_to_camera[3, :3]
        directions = torch.nn.functional.normalize(inputs[0] - settings.position, dim=1)
        visible = torch.ones(6, dtype=torch.bool)
        centres = surfels_oracle.bounds(rows.detach(), visible, 70, 45).centres
        pixels = torch.stack([torch.arange(70.0).repeat(45), torch.arange(45.0).repeat_interleave(70)], 1).double()
        order = torch.argsort(points[:, 2])
        hit = surfels_oracle.intersect(pixels, rows[order], centres[order])
        colour, others = surfels_oracle.blend(
            hit,
            inputs[3][order, 0],
            oracle.colours(directions, inputs[4], 3)[order],
            surfels_oracle.facing(normals, points)[order],
            settings.background,
        )
        weights = torch.randn(10, 45, 70, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
        (torch.cat([colour, others], 1) * weights.reshape(10, -1).T).sum().backward()
        expected = rows.grad[:, :2, 2] * points[:, 2:] * torch.tensor([35.0, 22.5])
        # All six are wider than their squares of tiles are cut, so that the whole image sees them.
        torch.testing.assert_close(gradients["viewspace"][:, :2], expected, rtol=1e-2, atol=1e-2)
        assert not gradients["viewspace"][:, 2].any()


def value_and_slope(inputs, settings, index, pixel, backend, channel=0):
    """A channel (of ten) at a pixel, and its gradient by all of inputs[index] together."""
    dtype = torch.float64 if backend == "torch" else torch.float32
    leaves = [tensor.detach().clone().to(dtype).requires_grad_() for tensor in inputs]
    image, _, others = draw(leaves, None, in_type(settings, dtype), backend)
    value = torch.cat([image, others])[(channel, *pixel)]
    (gradient,) = torch.autograd.grad(value, leaves[index])
    return value.item(), gradient.sum().item()


@pytest.mark.parametrize("backend", ["torch", "numba"])
class TestCuts:
    """Where the image has an edge or a kink in its parameters, its gradient cannot equal a finite difference."""

    PIXEL = 26, 36  # next to the disc's centre

    def test_the_faintest_alpha(self, backend):
        # Below 1/255 a disc is left out: the value jumps by 1/255, and the gradient sees neither side of the jump.
        settings, up = camera(degree=0), 3 + ALPHA
        falloff = value_and_slope(plane(opacity=0.5), settings, 3, self.PIXEL, backend, up)[0] / 0.5
        edge = MIN_ALPHA / falloff
        below, slope_below = value_and_slope(plane(opacity=edge * 0.999), settings, 3, self.PIXEL, backend, up)
        above, slope_above = value_and_slope(plane(opacity=edge * 1.001), settings, 3, self.PIXEL, backend, up)
        assert (below, slope_below) == (0, 0)
        assert above == pytest.approx(MIN_ALPHA, rel=2e-3)
        assert slope_above == pytest.approx(falloff, rel=1e-3)
        assert (above - below) / (0.002 * edge) > 100 * slope_above  # what a difference across it would report

    def test_the_ceiling_of_alpha(self, backend):
        # Above 0.99 the value stands still, and the gradient goes on as if it did not, as upstream.
        inputs, settings, up = plane(opacity=1.0), camera(degree=0), 3 + ALPHA
        value, slope = value_and_slope(inputs, settings, 3, self.PIXEL, backend, up)
        assert value == pytest.approx(MAX_ALPHA, rel=1e-6)
        assert slope == pytest.approx(1, abs=2e-3)
        inputs[3] -= 0.002
        assert value_and_slope(inputs, settings, 3, self.PIXEL, backend, up)[0] == value

    def test_the_last_of_the_light(self, backend):
        # The disc that would take the transmittance below 1e-4 is not drawn: the value jumps as the next appears.
        layers = [torch.cat([part] * 3) for part in plane(opacity=0.98)]
        layers[0][:, 2] = torch.tensor([0.0, 0.01, 0.02])
        settings = camera(degree=0)
        value = value_and_slope(layers, settings, 3, self.PIXEL, backend, 3 + ALPHA)[0]
        assert 1e-4 < 1 - value == pytest.approx(0.02**2, rel=0.1)  # 0.02^3 would be 8e-6

    def test_between_disc_and_screen(self, backend):
        # The falloff is the lesser of the two: continuous with a kink, at which a difference is the mean of both sides.
        settings, pixel = camera(degree=0), (27, 37)

        def at(size):
            return value_and_slope(plane(size=size), settings, 1, pixel, backend, 3 + ALPHA)

        # At `low` it is the screen's, which moves with the disc's size only as its box's centre does.
        low, high = 0.02, 0.04
        assert abs(at(low)[1]) < 1 < 3 < at(high)[1]
        for _ in range(30):
            middle = (low + high) / 2
            low, high = (middle, high) if at(middle)[1] < 3 else (low, middle)
        (below, flat), (above, steep) = at(low * 0.999), at(high * 1.001)
        assert above == pytest.approx(below, rel=0.02)
        assert abs(flat) < 0.1 * steep
        across = (at(high + 1e-4)[0] - at(low - 1e-4)[0]) / (high - low + 2e-4)
        assert across == pytest.approx((flat + steep) / 2, rel=0.05)


def shim():
    return build("diff_surfel_rasterization", table_for()["diff_surfel_rasterization"])


def inria_settings(module, view, modifier=1.0):
    return module.GaussianRasterizationSettings(
        image_height=view.height,
        image_width=view.width,
        tanfovx=0.0,  # not used
        tanfovy=0.0,
        bg=view.background,
        scale_modifier=modifier,
        viewmatrix=view.world_to_camera,
        projmatrix=view.projection,
        sh_degree=view.sh_degree,
        campos=view.position,
        prefiltered=False,
        debug=False,
    )


class TestShim:
    @pytest.mark.parametrize("modifier", [1.0, 0.5])
    def test_as_a_script_uses_it(self, modifier):
        module, view = shim(), in_type(camera(), torch.float32)
        settings = inria_settings(module, view, modifier)
        rasterizer = module.GaussianRasterizer(raster_settings=settings)
        means, scales, quaternions, opacities, sh = scene()
        screen = torch.zeros_like(means, requires_grad=True)
        image, radii, others = rasterizer(
            means3D=means.requires_grad_(),
            means2D=screen,
            shs=sh,
            colors_precomp=None,
            opacities=opacities,
            scales=scales,
            rotations=quaternions,
            cov3D_precomp=None,
        )
        wanted = rasterize_surfels(Surfels(means, opacities, modifier * scales, quaternions, sh=sh), view)
        assert all(torch.equal(got, expected) for got, expected in zip((image, radii, others), wanted))
        (image.sum() + others.sum()).backward()
        assert means.grad.any() and screen.grad[:, :2].any()
        front = rasterizer.markVisible(means)
        assert front.dtype == torch.bool and front.any()
        again = module.rasterize_gaussians(
            means, screen, sh, torch.Tensor([]), opacities, scales, quaternions, torch.Tensor([]), settings
        )
        assert torch.equal(again[0], image)

    def test_what_it_lacks(self):
        with pytest.raises(MissingShim, match=r"diff_surfel_rasterization\._C"):
            shim()._C  # noqa: B018

    def test_inputs_that_exclude_each_other(self):
        module, (means, scales, quaternions, opacities, sh) = shim(), scene()
        rasterizer = module.GaussianRasterizer(inria_settings(module, in_type(camera(), torch.float32)))
        given = {"means3D": means, "means2D": None, "opacities": opacities, "shs": sh, "scales": scales}
        for wrong, message in (
            (dict(given, shs=None, rotations=quaternions), "either shs or colors_precomp"),
            (given, "either scales and rotations"),
        ):
            with pytest.raises(LegsError, match=message):
                rasterizer(**wrong)
        with pytest.raises(MissingShim, match=r"forward\(theta=\.\.\.\)"):
            rasterizer(**given, rotations=quaternions, theta=torch.ones(1))


class TestRobustness:
    def test_inputs_that_do_not_fit(self):
        means, scales, quaternions, opacities, sh = scene()
        view = in_type(camera(), torch.float32)
        for wrong, message in (
            (Surfels(means, opacities, scales, quaternions), "either sh or colours"),
            (Surfels(means, opacities, None, quaternions, sh=sh), "either scales and quaternions"),
            (Surfels(means, opacities, torch.ones(40, 3), quaternions, sh=sh), r"scales \[40, 3\], expected"),
            (Surfels(means, opacities, scales, quaternions, sh=sh[:, :4]), "sh_degree 3"),
        ):
            with pytest.raises(LegsError, match=message):
                rasterize_surfels(wrong, view)

    def test_threads_do_not_change_the_result(self):
        numba = pytest.importorskip("numba")
        if numba.config.NUMBA_NUM_THREADS < 2:
            pytest.skip("one thread only")
        results = []
        for threads in (1, 2):
            numba.set_num_threads(threads)
            results.append(run(scene(200), camera(90, 70)))
        assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][2], results[1][2])
        for name in NAMES:
            assert torch.equal(results[0][3][name], results[1][3][name]), name
