"""The oracle of surfels against geometry and derivatives, and both rasterizers at their cuts."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from legs_loss.lab.conventions import MAX_ALPHA, MIN_ALPHA
from tests.lab import oracle
from tests.lab.surfels import oracle as surfels_oracle
from tests.lab.surfels.support import (
    ALPHA,
    BACKGROUND,
    DEPTH,
    DISTORTION,
    MEDIAN,
    NAMES,
    NORMAL,
    camera,
    draw,
    in_type,
    run,
    scene,
)


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
    """Edges and kinks of the image in its parameters, at which its gradient cannot equal a finite difference."""

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
