"""The compiled rasterizer against the readable one: values and gradients, ordinary scenes, extreme ones, a real one."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from legs_loss.errors import LegsError
from legs_loss.reference import Gaussians, rasterize
from tests.support import ROOT

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
    rendering = rasterize(*leaves[:5], view, BACKGROUND, degree, leaves[5], backend=backend)
    weights = torch.randn(3, view.height, view.width, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    (rendering.image * weights.to(dtype)).sum().backward()
    return rendering, dict(zip(NAMES, (leaf.grad for leaf in leaves)))


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
import numba
from tests.reference.test_rasterizer import camera, run, scene
for threads in (2, 1, 2):
    numba.set_num_threads(threads)
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


class TestInterface:
    def test_strided_input(self):
        inputs = scene()
        strided = [tensor.transpose(0, 1).contiguous().transpose(0, 1) for tensor in inputs]
        assert not strided[0].is_contiguous()
        assert torch.equal(
            rasterize(*inputs, camera(), BACKGROUND, 3).image, rasterize(*strided, camera(), BACKGROUND, 3).image
        )

    def test_a_strided_gradient(self):
        leaves = [tensor.requires_grad_() for tensor in scene()]
        image = rasterize(*leaves, camera(), BACKGROUND, 3).image
        strided, plain = (
            torch.autograd.grad(image, leaves, weights, retain_graph=True)
            for weights in (torch.ones(1).expand(3, 45, 70), torch.ones(3, 45, 70))
        )
        assert all(torch.equal(a, b) for a, b in zip(strided, plain))

    def test_only_what_requires_a_gradient_gets_one(self):
        inputs = scene()
        inputs[3].requires_grad_()
        rasterize(*inputs, camera(), BACKGROUND, 3).image.sum().backward()
        assert inputs[3].grad.abs().sum() > 0 and inputs[0].grad is None

    def test_two_columns_of_the_viewspace_are_the_first_two_of_four(self):
        gradients = []
        for columns in (2, 4):
            viewspace = torch.zeros(40, columns, requires_grad=True)
            rasterize(*scene(), camera(), BACKGROUND, 3, viewspace).image.square().sum().backward()
            gradients.append(viewspace.grad)
        assert torch.equal(gradients[0], gradients[1][:, :2])
        assert (gradients[1][:, 2:] >= gradients[1][:, :2].abs() * (1 - 1e-5)).all()

    def test_coefficients_beyond_the_degree_are_not_used(self):
        inputs = scene()
        low = rasterize(*inputs[:4], inputs[4][:, :4].contiguous(), camera(), BACKGROUND, 1).image
        assert torch.equal(rasterize(*inputs, camera(), BACKGROUND, 1).image, low)
        _, gradients = run(inputs, camera(), 1)
        assert (gradients["sh"][:, 4:] == 0).all()

    def test_gradients_lead_to_the_target(self):
        target = rasterize(*scene(20, seed=3), camera(), BACKGROUND, 3).image
        leaves = [tensor.requires_grad_() for tensor in scene(20, seed=3)]
        with torch.no_grad():
            leaves[0] += 0.05 * torch.randn(20, 3)
            leaves[4] += 0.2 * torch.randn(20, 16, 3)
        optimizer = torch.optim.Adam([leaves[0], leaves[4]], lr=0.01)
        losses = []
        for _ in range(60):
            loss = (rasterize(*leaves, camera(), BACKGROUND, 3).image - target).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
        assert losses[-1] < 0.1 * losses[0]

    def test_a_million_fits(self):
        rendering, gradients = run(scene(1_000_000, smallest=0.001, largest=0.004, degree=0), camera(64, 48), 0)
        assert torch.isfinite(rendering.image).all()
        assert all(torch.isfinite(gradient).all() for gradient in gradients.values())


class TestErrors:
    @pytest.mark.parametrize("index", range(5))
    @pytest.mark.parametrize("backend", ["numba", "torch"])
    def test_a_wrong_shape_names_all_of_them(self, index, backend):
        inputs = scene()
        inputs[index] = inputs[index][:, :-1] if index < 4 else inputs[index][:-1]
        with pytest.raises(
            LegsError, match=r"of the wrong shape among means \[.*scales \[.*opacities \[.*sh \["
        ) as error:
            rasterize(*inputs, camera(), BACKGROUND, 3, backend=backend)
        assert str(error.value).startswith(NAMES[index] if index else "means")

    @pytest.mark.parametrize("index", range(5))
    @pytest.mark.parametrize("backend", ["numba", "torch"])
    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_a_value_that_is_not_a_number(self, index, backend, value):
        inputs = scene()
        inputs[index].view(40, -1)[7, -1] = value
        with pytest.raises(LegsError, match=rf"{NAMES[index]} \[40, .* in 1 of its 40 rows, first in row 7"):
            rasterize(*inputs, camera(), BACKGROUND, 3, backend=backend)

    def test_a_large_finite_value_is_none(self):
        inputs = scene()
        inputs[0][:2, 0] = 3e38  # their sum is infinite
        assert torch.isfinite(rasterize(*inputs, camera(), BACKGROUND, 3).image).all()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"sh_degree": 4}, "sh_degree is 4"),
            ({"background": (0.0, 1.0)}, "background has shape"),
            ({"viewspace": torch.zeros(40, 3)}, r"viewspace has shape \[40, 3\]; expected \[40, 2\] or \[40, 4\]"),
            ({"backend": "cuda"}, "no rasterizer backend 'cuda'; choose one of numba, torch"),
        ],
    )
    def test_wrong_options(self, options, message):
        arguments = {"background": BACKGROUND, "sh_degree": 3, **options}
        with pytest.raises(LegsError, match=message):
            rasterize(*scene(), camera(), **arguments)

    def test_too_few_coefficients(self):
        with pytest.raises(LegsError, match="needs K >= 16 coefficients; sh has 9"):
            rasterize(*scene(degree=2), camera(), BACKGROUND, 3)

    def test_float64_is_the_oracle_s(self):
        with pytest.raises(LegsError, match=r"computes in float32, not torch\.float64"):
            rasterize(*[tensor.double() for tensor in scene()], camera(), BACKGROUND, 3)

    def test_mixed_types(self):
        inputs = scene()
        inputs[0] = inputs[0].double()
        with pytest.raises(LegsError, match="must share one floating type"):
            rasterize(*inputs, camera(), BACKGROUND, 3)

    def test_a_camera_that_cannot_be(self):
        view = camera()
        view.world_to_camera = np.zeros((4, 4))
        with pytest.raises(LegsError, match="cannot be inverted"):
            rasterize(*scene(), view, BACKGROUND, 3)
        view = camera()
        view.width = 0
        with pytest.raises(LegsError, match="found 0x45"):
            rasterize(*scene(), view, BACKGROUND, 3)

    def test_an_image_too_large_for_the_compiled_one(self):
        pytest.importorskip("numba")
        from legs_loss.reference.rasterizer import sorting

        nothing = np.empty(0, np.float32), np.empty(0, np.int64)
        firsts, reached = sorting.make_slots(np.empty((0, 4), np.int32), nothing[1], 32)
        with pytest.raises(LegsError, match="2048 x 257 strips cannot be drawn"):  # 16384 x 8224 pixels
            sorting.sort_entries(*nothing, firsts, reached, 2048, 257)
        sorting.sort_entries(*nothing, firsts, reached, 2048, 256)

    def test_without_numba(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "numba", None)
        with pytest.raises(LegsError, match=r"pip install 'legs-loss\[cpu\]"):
            rasterize(*scene(), camera(), BACKGROUND, 3)


def test_without_a_place_for_the_cache(monkeypatch):
    import numba

    from legs_loss.kernels.compiling import compiled

    njit = numba.njit

    def refuses(*arguments, **options):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(*arguments, **options)

    monkeypatch.setattr(numba, "njit", refuses)
    assert compiled()(lambda x: x + 1)(2) == 3


def test_exp2():
    import numba

    from legs_loss.kernels.simd import LANES, load, store
    from legs_loss.reference.rasterizer.strips import exp2

    @numba.njit
    def by_lanes(exponents, powers):
        for i in range(0, len(exponents), LANES):
            store(powers, i, exp2(load(exponents, i)))

    exponents = np.linspace(-30, 0, 3008, dtype=np.float32)
    powers = np.empty_like(exponents)
    by_lanes(exponents, powers)
    np.testing.assert_allclose(powers, np.exp2(exponents.astype(np.float64)), rtol=5e-7)
