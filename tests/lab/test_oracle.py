"""The readable rasterizer against numbers worked by hand, finite differences, and the mathematics it states."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from legs_loss.lab.conventions import SH_C0, SH_C1
from tests.lab.oracle import colours, rasterize

BACKGROUND = (0.1, 0.2, 0.3)


def camera(width=33, height=33, focal=40.0, cx=None, cy=None, pose=None):
    return SimpleNamespace(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=width / 2 if cx is None else cx,
        cy=height / 2 if cy is None else cy,
        world_to_camera=np.eye(4) if pose is None else pose,
    )


def balls(centres, opacities, rgb, scale=0.1):
    """Round Gaussians of degree 0, float64."""
    count = len(centres)
    means = torch.tensor(centres, dtype=torch.float64).reshape(count, 3)
    quaternions = torch.zeros(count, 4, dtype=torch.float64)
    quaternions[:, 0] = 1
    sh = (torch.tensor(rgb, dtype=torch.float64).reshape(count, 1, 3) - 0.5) / SH_C0
    opacity = torch.tensor(opacities, dtype=torch.float64).reshape(count, 1)
    return [means, torch.full((count, 3), scale, dtype=torch.float64), quaternions, opacity, sh]


def draw(inputs, view=None, degree=0, **options):
    return rasterize(*inputs, view or camera(), BACKGROUND, degree, **options)


def random_scene(count, degree, seed):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    means = 0.3 * normal(count, 3) + torch.tensor([0.0, 0.0, 2.0])
    scales = 0.05 + 0.2 * torch.rand(count, 3, generator=generator, dtype=torch.float64)
    opacities = 0.1 + 0.8 * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return [means, scales, normal(count, 4), opacities, 0.3 * normal(count, (degree + 1) ** 2, 3)]


class TestByHand:
    def test_one_ball(self):
        image, radii = draw(balls([[0, 0, 2]], [0.8], [[1.0, 0.5, 0.0]]))
        variance = (40 * 0.1 / 2) ** 2 + 0.3
        for dx, dy in ((0, 0), (3, 0), (-2, 1)):
            alpha = 0.8 * math.exp(-(dx * dx + dy * dy) / (2 * variance))
            for channel, (front, behind) in enumerate(zip((1.0, 0.5, 0.0), BACKGROUND)):
                expected = alpha * front + (1 - alpha) * behind
                assert image[channel, 16 + dy, 16 + dx].item() == pytest.approx(expected, abs=1e-12)
        assert radii.tolist() == [math.ceil(3 * math.sqrt(variance + math.sqrt(0.1)))]
        assert radii.dtype == torch.int32

    def test_a_centred_camera_is_3dgs_s(self):
        # ((ndc + 1) * W - 1) / 2 with ndc = 2 f x / (z W): the ball stands on pixel (16 + 4, 16 - 6).
        image, _ = draw(balls([[0.2, -0.3, 2]], [0.8], [[1.0, 1.0, 1.0]]))
        assert divmod(image[0].argmax().item(), 33) == (10, 20)

    def test_the_principal_point_moves_the_image(self):
        ball = balls([[0, 0, 2]], [0.8], [[1.0, 1.0, 1.0]])
        image, _ = draw(ball)
        moved, _ = draw(ball, camera(cx=33 / 2 + 3, cy=33 / 2 - 2))
        torch.testing.assert_close(moved[:, 6:20, 11:25], image[:, 8:22, 8:22])

    @pytest.mark.parametrize("order", [[0, 1], [1, 0]])
    def test_the_nearer_one_is_in_front_whatever_the_order(self, order):
        near, far = [0, 0, 2.0], [0, 0, 3.0]
        rgb = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
        image, _ = draw(balls([[near, far][k] for k in order], [[0.5, 0.9][k] for k in order], [rgb[k] for k in order]))
        expected = [0.5 + 0.5 * 0.1 * 0.1, 0.5 * 0.9 + 0.5 * 0.1 * 0.2, 0.5 * 0.1 * 0.3]
        assert image[:, 16, 16].tolist() == pytest.approx(expected, abs=1e-12)

    def test_equal_depths_keep_their_order(self):
        image, _ = draw(balls([[0, 0, 2]] * 2, [0.5, 0.5], [[1.0, 0, 0], [0, 1.0, 0]]))
        assert image[:2, 16, 16].tolist() == pytest.approx([0.5 + 0.25 * 0.1, 0.25 + 0.25 * 0.2])

    def test_the_opacity_has_a_ceiling_of_99_percent(self):
        image, _ = draw(balls([[0, 0, 2]], [1.0], [[1.0, 1.0, 1.0]]))
        assert image[0, 16, 16].item() == pytest.approx(0.99 + 0.01 * 0.1, abs=1e-7)

    def test_what_is_fainter_than_1_in_255_is_skipped(self):
        image, radii = draw(balls([[0, 0, 2]], [0.999 / 255], [[1.0, 1.0, 1.0]]))
        assert torch.equal(image, torch.tensor(BACKGROUND, dtype=torch.float64)[:, None, None].expand(3, 33, 33))
        assert radii[0] > 0  # yet it counts as seen, as in 3DGS
        image, _ = draw(balls([[0, 0, 2]], [1.001 / 255], [[1.0, 1.0, 1.0]]))
        assert (image[0] != 0.1).sum() == 1

    def test_a_pixel_ends_before_its_transmittance_falls_below_1e_4(self):
        # 0.05^3 = 1.25e-4 is left after three; a fourth would leave 6e-6, and is not drawn.
        image, _ = draw(balls([[0, 0, 2 + 0.1 * k] for k in range(5)], [0.95] * 5, [[0.0] * 3] * 3 + [[1.0] * 3] * 2))
        assert image[0, 16, 16].item() == pytest.approx(0.05**3 * 0.1, rel=1e-9)

    def test_two_opaque_ones_finish_a_pixel(self):
        # In float32 (1 - 0.99)^2 is below 1e-4: the second is not drawn any more, in whatever type.
        image, _ = draw(balls([[0, 0, 2], [0, 0, 3]], [1.0, 1.0], [[0.0] * 3, [1.0] * 3]))
        assert image[0, 16, 16].item() == pytest.approx(0.01 * 0.1, abs=1e-7)

    def test_the_near_plane(self):
        _, radii = draw(balls([[0, 0, 0.2], [0, 0, 0.2001], [0, 0, -1]], [0.5] * 3, [[1.0] * 3] * 3, scale=0.001))
        assert (radii > 0).tolist() == [False, True, False]

    def test_only_the_tiles_of_the_square_are_drawn(self):
        # As 3DGS rounds it, a square of radius 25 around 7.9 does not touch the tile that begins at 32.
        ball = balls([[0, 0, 2]], [0.99], [[1.0, 1.0, 1.0]], scale=0.4)
        image, radii = draw(ball, camera(width=64, cx=8.4))
        assert radii.tolist() == [25]
        assert (image[0, 16, :32] > 0.1).all() and (image[0, :, 32:] == 0.1).all()
        assert 0.99 * math.exp(-((32 - 7.9) ** 2) / (2 * (8**2 + 0.3))) > 2 / 255

    def test_the_guard_holds_the_jacobian_outside_the_image(self):
        # x/z = 1.5, held at 1.3 * 64 / 80 = 1.04: the horizontal spread is (f s / z) sqrt(1 + 1.04^2).
        ball = balls([[3.0, 0, 2]], [0.9], [[1.0, 1.0, 1.0]], scale=0.5)
        image, _ = draw(ball, camera(width=64, cx=16.5))  # centred on x = 76, y = 16
        limit = 1.3 * 64 / 80
        variance_x, variance_y = (40 * 0.5 / 2) ** 2 * (1 + limit**2) + 0.3, (40 * 0.5 / 2) ** 2 + 0.3
        alpha = 0.9 * math.exp(-((60 - 76) ** 2) / (2 * variance_x) - 3**2 / (2 * variance_y))
        assert image[0, 19, 60].item() == pytest.approx(alpha + (1 - alpha) * 0.1, abs=1e-9)

    def test_a_turned_needle_lies_where_its_quaternion_says(self):
        # 90 degrees about z turn the long x axis onto y.
        needle = balls([[0, 0, 2]], [0.9], [[1.0, 1.0, 1.0]])
        needle[1] = torch.tensor([[0.3, 0.01, 0.01]], dtype=torch.float64)
        needle[2] = 7 * torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]], dtype=torch.float64)
        image, _ = draw(needle)
        alpha = 0.9 * math.exp(-(5**2) / (2 * ((40 * 0.3 / 2) ** 2 + 0.3)))
        assert image[0, 21, 16].item() == pytest.approx(alpha + (1 - alpha) * 0.1, abs=1e-9)
        assert image[0, 16, 21].item() == pytest.approx(0.1)


class TestHarmonics:
    def test_degree_1_by_formula(self):
        sh = torch.randn(1, 4, 3, dtype=torch.float64)
        x, y, z = 0.48, -0.6, 0.64
        expected = SH_C0 * sh[0, 0] - SH_C1 * y * sh[0, 1] + SH_C1 * z * sh[0, 2] - SH_C1 * x * sh[0, 3] + 0.5
        got = colours(torch.tensor([[x, y, z]], dtype=torch.float64), sh, 1)
        torch.testing.assert_close(got[0], expected.clamp_min(0))

    def test_the_sixteen_are_orthonormal_on_the_sphere(self):
        heights, weights = np.polynomial.legendre.leggauss(8)
        angles = np.arange(16) * 2 * math.pi / 16
        z, angle = np.repeat(heights, 16), np.tile(angles, 8)
        ring = np.sqrt(1 - z * z)
        directions = torch.tensor(np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1))
        area = torch.tensor(np.repeat(weights, 16) * 2 * math.pi / 16)
        basis = []
        for k in range(16):
            sh = torch.zeros(len(directions), 16, 3, dtype=torch.float64)
            sh[:, k] = 0.1  # small, so that nothing is clamped at 0
            basis.append((colours(directions, sh, 3)[:, 0] - 0.5) / 0.1)
        basis = torch.stack(basis)
        torch.testing.assert_close((basis * area) @ basis.T, torch.eye(16, dtype=torch.float64), atol=1e-12, rtol=0)

    def test_the_direction_runs_from_the_camera_to_the_gaussian(self):
        ball = balls([[0.0, 0, 2]], [0.9], [[0.5] * 3])
        ball[4] = torch.zeros(1, 4, 3, dtype=torch.float64)
        ball[4][0, 2] = 1.0  # the harmonic of z
        image, _ = draw(ball, degree=1)
        assert image[0, 16, 16].item() == pytest.approx(0.9 * (0.5 + SH_C1) + 0.1 * 0.1)

    def test_black_is_a_floor_without_gradient(self):
        ball = balls([[0, 0, 2]], [0.9], [[-0.5, 0.5, 0.5]])
        ball[4].requires_grad_()
        image, _ = draw(ball)
        assert image[0, 16, 16].item() == pytest.approx(0.1 * 0.1)
        image.sum().backward()
        assert ball[4].grad[0, 0, 0] == 0 and ball[4].grad[0, 0, 1] > 0


class TestGradient:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_finite_differences(self, degree):
        pose = np.eye(4)
        pose[:3, :3] = [[math.cos(0.3), 0, math.sin(0.3)], [0, 1, 0], [-math.sin(0.3), 0, math.cos(0.3)]]
        pose[:3, 3] = 0.1, -0.2, 0.5
        inputs = random_scene(4, degree, seed=degree)
        in_camera = inputs[0] * torch.tensor([0.4, 0.4, 1.0])
        assert ((in_camera / in_camera[:, 2:])[:, :2].abs() < 0.4).all()  # within the guard, 1.3 * 6 / 16 = 0.49
        inputs[0] = (in_camera - torch.tensor(pose[:3, 3])) @ torch.tensor(pose[:3, :3])
        view = camera(width=7, height=6, focal=8.0, cx=3.3, cy=3.1, pose=pose)
        inputs = [tensor.requires_grad_() for tensor in inputs]
        assert torch.autograd.gradcheck(lambda *tensors: draw(tensors, view, degree).image, inputs)

    def test_where_the_guard_holds_x_its_gradient_is_upstream_s(self):
        # There x = 1.04 z in the Jacobian, yet upstream differentiates as if that x were a constant.
        ball = balls([[3.0, 0, 2]], [0.9], [[1.0, 1.0, 1.0]], scale=0.5)
        ball[0].requires_grad_()
        draw(ball, camera(width=64, cx=16.5)).image[0, 16, 60].backward()
        held = 1.04 * 2
        variance = 0.25 * 1600 * (1 / 4 + held**2 / 16) + 0.3
        variance_by_z = 0.25 * 1600 * (-2 / 8 - 4 * held**2 / 32)
        dx, centre_by_z = 60 - 76, -40 * 3 / 4
        alpha = 0.9 * math.exp(-(dx**2) / (2 * variance))
        expected = alpha * (dx / variance * centre_by_z + dx**2 / (2 * variance**2) * variance_by_z) * (1 - 0.1)
        assert ball[0].grad[0, 2].item() == pytest.approx(expected, rel=1e-6)

    def test_the_gradient_passes_the_ceiling_of_the_opacity(self):
        # As upstream: at the centre alpha is 0.99 whatever the opacity, yet its gradient is that of alpha = opacity.
        ball = balls([[0, 0, 2]], [1.0], [[1.0, 1.0, 1.0]])
        ball[3].requires_grad_()
        draw(ball).image[0, 16, 16].backward()
        assert ball[3].grad.item() == pytest.approx(1.0 - 0.1)

    @pytest.mark.parametrize("columns", [2, 4])
    def test_the_viewspace_gradient_is_the_pixel_gradient_times_half_the_size(self, columns):
        # Moving the principal point moves every centre and nothing else.
        inputs, weights = random_scene(5, 1, seed=7), torch.randn(3, 20, 24, dtype=torch.float64)
        viewspace = torch.zeros(5, columns, dtype=torch.float64, requires_grad=True)

        def loss(cx, cy, **options):
            return (draw(inputs, camera(24, 20, 22.0, cx, cy), 1, **options).image * weights).sum()

        loss(12.0, 10.0, viewspace=viewspace).backward()
        step = 1e-5
        by_x = (loss(12.0 + step, 10.0) - loss(12.0 - step, 10.0)) / (2 * step)
        by_y = (loss(12.0, 10.0 + step) - loss(12.0, 10.0 - step)) / (2 * step)
        assert viewspace.grad[:, 0].sum().item() == pytest.approx(12 * by_x.item(), rel=1e-5)
        assert viewspace.grad[:, 1].sum().item() == pytest.approx(10 * by_y.item(), rel=1e-5)

    def test_the_absolute_columns_add_up_what_the_others_cancel(self):
        ball = balls([[0, 0, 2]], [0.5], [[1.0, 1.0, 1.0]])
        viewspace = torch.zeros(1, 4, dtype=torch.float64, requires_grad=True)
        draw(ball, viewspace=viewspace).image.sum().backward()
        variance = (40 * 0.1 / 2) ** 2 + 0.3
        total = 0.0
        for dx in range(-16, 17):
            for dy in range(-16, 17):
                alpha = 0.5 * math.exp(-(dx * dx + dy * dy) / (2 * variance))
                if alpha >= 1 / 255:
                    total += alpha * abs(dx) / variance * (3 - sum(BACKGROUND))
        assert viewspace.grad[0, :2].tolist() == pytest.approx([0, 0], abs=1e-9)
        assert viewspace.grad[0, 2:].tolist() == pytest.approx([total * 33 / 2] * 2)

    def test_nothing_seen_still_gives_gradients(self):
        inputs = [tensor.requires_grad_() for tensor in balls([[0, 0, -2.0]], [0.5], [[1.0] * 3])]
        draw(inputs).image.sum().backward()
        assert all(tensor.grad.abs().sum() == 0 for tensor in inputs)
