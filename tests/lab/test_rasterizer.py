"""The compiled rasterizer against the readable one: values and gradients, ordinary scenes, extreme ones, a real one."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss.lab.rasterizer import Gaussians, rasterize
from tests.lab.rasterizing import BACKGROUND, NAMES, camera, run, scene
from tests.support import ROOT


def assert_agree(inputs, view, degree=3, tolerance=1e-4):
    rendering, gradients = run(inputs, view, degree)
    expected, expected_gradients = run(inputs, view, degree, "torch", torch.float64)
    assert rendering.image.dtype == torch.float32
    assert torch.equal(rendering.radii, expected.radii)
    torch.testing.assert_close(rendering.image.double(), expected.image, atol=tolerance, rtol=0)
    for name in NAMES:
        got, wanted = gradients[name].double(), expected_gradients[name]
        size = wanted.norm()
        if size < 1e-12:  # as of the quaternion of a ball, which is zero but for rounding
            assert got.norm() < 1e-12, name
        else:
            assert (got - wanted).norm() < tolerance * size, name
            assert (got * wanted).sum() > 0.9999 * got.norm() * size, name
    return rendering


class TestAgreement:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_every_degree(self, degree):
        assert_agree(scene(degree=3), camera(), degree)

    def test_a_crowd(self):
        assert (assert_agree(scene(1500), camera(100, 83)).radii > 0).sum() > 1000

    @pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 40), (17, 1), (7, 33), (33, 65), (16, 32)])
    def test_odd_sizes(self, width, height):
        assert_agree(scene(60), camera(width, height, focal=20.0))

    def test_no_gaussians(self):
        rendering = assert_agree(scene(0), camera())
        assert torch.equal(rendering.image, torch.tensor(BACKGROUND)[:, None, None].expand(3, 45, 70))

    def test_one(self):
        assert_agree(scene(1), camera())

    def test_all_behind_the_camera(self):
        inputs = scene()
        inputs[0] -= torch.tensor([0.0, 0.0, 30.0])
        assert (assert_agree(inputs, camera()).radii == 0).all()

    def test_all_beside_the_image(self):
        inputs = scene(smallest=0.001, largest=0.01)
        inputs[0] = 0.1 * inputs[0] + torch.tensor([50.0, 0.0, 5.0])
        assert (assert_agree(inputs, camera()).radii == 0).all()

    def test_some_around_the_camera(self):
        inputs = scene(200, spread=3.0)
        radii = assert_agree(inputs, camera()).radii
        assert (radii == 0).any() and (radii > 45).any()

    def test_giants(self):
        assert_agree(scene(20, smallest=5.0, largest=500.0), camera())

    def test_needles(self):
        inputs = scene(50)
        inputs[1] = torch.tensor([[2.0, 1e-4, 1e-4]]).repeat(50, 1)
        assert_agree(inputs, camera())

    def test_giant_needles(self):
        inputs = scene(20)
        inputs[1] = torch.tensor([[100.0, 1e-3, 1e-3]]).repeat(20, 1)
        assert_agree(inputs, camera())

    def test_dust(self):
        assert_agree(scene(300, smallest=1e-7, largest=1e-5), camera())

    def test_opaque(self):
        inputs = scene(200, smallest=0.1)
        inputs[3][:] = 1.0
        assert_agree(inputs, camera())

    def test_transparent(self):
        inputs = scene()
        inputs[3][::2] = 0.0
        inputs[3][1::4] = 1 / 256
        assert_agree(inputs, camera())

    def test_duplicates_at_one_depth_keep_their_order(self):
        inputs = [tensor.repeat_interleave(3, 0) for tensor in scene(15)]
        inputs[4] = scene(45)[4]
        assert_agree(inputs, camera())

    def test_depth_decides_to_the_last_bit(self):
        inputs = scene(64, smallest=0.2, largest=0.4)
        view = camera()
        view.world_to_camera = np.eye(4)
        inputs[0] *= 0.2
        inputs[0][:, 2] = 4 + torch.randperm(64) * 2.0**-21  # neighbours among the float32 between 4 and 8
        assert_agree(inputs, view)

    @settings(max_examples=25, deadline=None)
    @given(
        count=st.integers(0, 30),
        seed=st.integers(0, 10**6),
        size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
        spread=st.floats(0.0, 4.0),
        smallest=st.floats(1e-4, 1.0),
        ratio=st.floats(1.0, 300.0),
        degree=st.integers(0, 3),
    )
    def test_random_scenes(self, count, seed, size, spread, smallest, ratio, degree):
        inputs = scene(count, seed, spread, smallest, smallest * ratio)
        assert_agree(inputs, camera(*size, focal=25.0), degree, tolerance=1e-3)


@pytest.fixture(scope="module")
def fox_scene(fox):
    from legs_loss.scenes import read_scene

    found = read_scene(fox)
    gaussians = Gaussians.from_points(found.points.xyz, found.points.rgb)
    generator = torch.Generator().manual_seed(1)
    # As after some training: of every shape, opacity and colour.
    gaussians.log_scales += 0.5 * torch.randn(len(gaussians), 3, generator=generator)
    gaussians.quaternions += torch.randn(len(gaussians), 4, generator=generator)
    gaussians.opacity_logits += 2 * torch.randn(len(gaussians), 1, generator=generator)
    gaussians.sh += 0.1 * torch.randn(gaussians.sh.shape, generator=generator)
    inputs = [gaussians.means, gaussians.scales, gaussians.quaternions, gaussians.opacities, gaussians.sh]
    return inputs, found.views


@pytest.mark.slow
@pytest.mark.parametrize(("view", "degree"), [(0, 0), (17, 1), (33, 3)])
def test_a_real_view(fox_scene, view, degree):
    inputs, views = fox_scene
    rendering = assert_agree(inputs, views[view].camera.resized(68, 120), degree, tolerance=1e-3)
    assert (rendering.radii > 0).sum() > 3000


def test_a_start_from_points_looks_like_the_photograph(fox):
    from legs_loss.scenes import read_scene
    from legs_loss.scenes.images import load_training_image

    found = read_scene(fox)
    start = Gaussians.from_points(found.points.xyz, found.points.rgb, sh_degree=0, opacity=0.9)
    view = found.views[20]
    photograph = torch.as_tensor(load_training_image(view)[..., :3].copy()).permute(2, 0, 1)[None] / 255
    photograph = torch.nn.functional.interpolate(photograph, size=(160, 90), mode="area")[0]
    image, _ = rasterize(
        start.means,
        start.scales,
        start.quaternions,
        start.opacities,
        start.sh,
        view.camera.resized(90, 160),
        (0, 0, 0),
        0,
    )
    together = torch.corrcoef(torch.stack([image.flatten(), photograph.flatten()]))[0, 1]
    assert together > 0.6


class TestRepeatability:
    PROGRAM = """
import hashlib, sys
import torch
from tests.lab.rasterizing import camera, run, scene
for threads in (2, 1, 2):
    torch.set_num_threads(threads)
    rendering, gradients = run(scene(3000), camera(130, 120, 100.0))
    digest = hashlib.sha256(rendering.image.detach().numpy().tobytes())
    for gradient in gradients.values():
        digest.update(gradient.numpy().tobytes())
    print(digest.hexdigest())
"""

    def test_bit_for_bit_whatever_the_number_of_threads(self):
        root = str(ROOT)
        environment = dict(os.environ, NUMBA_NUM_THREADS="2", PYTHONPATH=root)
        digests = subprocess.run(
            [sys.executable, "-c", self.PROGRAM], env=environment, cwd=root, stdout=subprocess.PIPE, check=True
        ).stdout.split()
        assert len(digests) == 3 and len(set(digests)) == 1

    def test_a_second_backward_repeats_the_first(self):
        leaves = [tensor.requires_grad_() for tensor in scene()]
        image = rasterize(*leaves, camera(), BACKGROUND, 3).image
        first = torch.autograd.grad(image.square().sum(), leaves, retain_graph=True)
        second = torch.autograd.grad(image.square().sum(), leaves)
        assert all(torch.equal(a, b) for a, b in zip(first, second))

    def test_after_the_way_back_nothing_is_kept(self):
        leaves = [tensor.requires_grad_() for tensor in scene()]
        image = rasterize(*leaves, camera(), BACKGROUND, 3).image
        image.sum().backward()
        with pytest.raises(RuntimeError, match="backward through the graph a second time"):
            image.sum().backward()


def test_exp2():
    import numba

    from legs_loss.lab.rasterizer.strips import exp2
    from legs_loss.lab.simd.memory import load, store
    from legs_loss.lab.simd.vectors import LANES

    @numba.njit
    def by_lanes(exponents, powers):
        for i in range(0, len(exponents), LANES):
            store(powers, i, exp2(load(exponents, i)))

    exponents = np.linspace(-30, 0, 3008, dtype=np.float32)
    powers = np.empty_like(exponents)
    by_lanes(exponents, powers)
    np.testing.assert_allclose(powers, np.exp2(exponents.astype(np.float64)), rtol=5e-7)
