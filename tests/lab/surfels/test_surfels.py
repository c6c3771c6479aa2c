"""The compiled rasterizer of surfels against the oracle, and its shim."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from legs_adapters.shims.finder import build, table_for
from legs_adapters.shims.missing import MissingShim

from legs_loss import LegsError
from legs_loss.lab.surfels import Surfels, rasterize_surfels
from tests.lab.surfels import oracle as surfels_oracle
from tests.lab.surfels.support import (
    ALPHA,
    BACKGROUND,
    NAMES,
    camera,
    draw,
    in_type,
    rasterize_by,
    run,
    scene,
)


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
            image, _, _ = rasterize_by(backend, Surfels(*geometry, colours=colours), in_type(camera(), dtype))
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
            image, _, others = rasterize_by(backend, handed, in_type(settings, dtype))
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
            image, _, others = rasterize_by(backend, handed, in_type(camera(), dtype))
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
        results = []
        for threads in (2, 1):
            torch.set_num_threads(threads)
            results.append(run(scene(200), camera(90, 70)))
        assert torch.equal(results[0][0], results[1][0]) and torch.equal(results[0][2], results[1][2])
        for name in NAMES:
            assert torch.equal(results[0][3][name], results[1][3][name]), name
