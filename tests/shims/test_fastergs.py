"""FasterGS's compiled functions on the CPU: against its formulas written out, and torch's Adam."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from legs_adapters.shims.finder import build, table_for
from legs_adapters.shims.missing import MissingShim
from legs_adapters.shims.modules import FasterGSCudaBackend as fastergs
from legs_adapters.shims.modules.MortonEncoding import morton_encode

from legs_loss import LegsError
from tests.lab import oracle

NAMES = ("means", "scales", "rotations", "opacities", "sh_0", "sh_rest")


def settings(width=50, height=34, bases=16, near=0.2, far=1000.0, antialiasing=False, shift=0.0, dtype=torch.float32):
    c, s = math.cos(0.3), math.sin(0.3)
    w2c = torch.tensor([[c, 0, s, 0.1], [0, 1, 0, 0.2], [-s, 0, c, 3.0], [0, 0, 0, 1]], dtype=torch.float64)
    return fastergs._Settings(
        w2c=w2c.to(dtype),
        cam_position=torch.linalg.inv(w2c)[:3, 3].to(dtype),
        bg_color=torch.tensor([0.2, 0.5, 0.8], dtype=dtype),
        active_sh_bases=bases,
        width=width,
        height=height,
        focal_x=45.0,
        focal_y=47.0,
        center_x=width / 2 + shift,
        center_y=height / 2 - shift,
        near_plane=near,
        far_plane=far,
        proper_antialiasing=antialiasing,
    )


def scene(count=40, seed=0, dtype=torch.float32, faint=False):
    """Means, logarithms of scales, quaternions of any length, logits, first and other harmonics."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator).to(dtype)

    logits = (2 * normal(count, 1)).clamp_max(4)  # 0.982: below the ceiling of alpha
    if faint:
        logits = logits.clamp(-4, -0.85)
    return [normal(count, 3), -2.5 + 0.7 * normal(count, 3), 3 * normal(count, 4), logits,
            normal(count, 1, 3), 0.3 * normal(count, 15, 3)]  # fmt: skip


def written_out(raw, camera, falloffs=None):
    """FasterGS's image from its formulas: every Gaussian at every pixel, centres at +0.5; and the centres.

    `falloffs` is filled with the falloff at every pixel of each Gaussian that is drawn, or gives it.
    """
    means, scales, rotations, opacities, first, rest = raw
    points = means @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
    order = torch.argsort(points[:, 2])
    order = order[(points[order, 2] >= camera.near_plane) & (points[order, 2] <= camera.far_plane)]
    x, y, z = points.unbind(1)
    unit = torch.nn.functional.normalize(rotations, dim=1)
    w, i, j, k = unit.unbind(1)
    turn = torch.stack(
        [
            *(1 - 2 * (j * j + k * k), 2 * (i * j - w * k), 2 * (i * k + w * j)),
            *(2 * (i * j + w * k), 1 - 2 * (i * i + k * k), 2 * (j * k - w * i)),
            *(2 * (i * k - w * j), 2 * (j * k + w * i), 1 - 2 * (i * i + j * j)),
        ],
        1,
    ).reshape(-1, 3, 3)
    covariance = turn @ torch.diag_embed((2 * scales).exp()) @ turn.transpose(1, 2)
    left, right = (-0.15 * camera.width - camera.center_x) / camera.focal_x, 1.15 * camera.width - camera.center_x
    top, bottom = (-0.15 * camera.height - camera.center_y) / camera.focal_y, 1.15 * camera.height - camera.center_y
    u, v = (x / z).clamp(left, right / camera.focal_x), (y / z).clamp(top, bottom / camera.focal_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [camera.focal_x / z, zero, -camera.focal_x * u / z, zero, camera.focal_y / z, -camera.focal_y * v / z], 1
    ).reshape(-1, 2, 3)
    on_image = jacobian @ camera.w2c[:3, :3]
    sharp = on_image @ covariance @ on_image.transpose(1, 2)
    flat = sharp + (0.1 if camera.proper_antialiasing else 0.3) * torch.eye(2, dtype=means.dtype)
    conic = torch.linalg.inv(flat)
    alphas = torch.sigmoid(opacities)
    if camera.proper_antialiasing:  # as upstream, a constant to the gradient
        alphas = alphas * (torch.linalg.det(sharp) / torch.linalg.det(flat)).clamp_min(0).sqrt().detach()[:, None]
    centres = torch.stack([x / z * camera.focal_x + camera.center_x, y / z * camera.focal_y + camera.center_y], 1)
    if centres.requires_grad:
        centres.retain_grad()
    degree = round(camera.active_sh_bases**0.5) - 1
    directions = torch.nn.functional.normalize(means - camera.cam_position, dim=1)
    colours = oracle.colours(directions, torch.cat([first, rest], 1), degree)
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns, rows], 2).to(means.dtype) + 0.5
    image, left_over = torch.zeros(camera.height, camera.width, 3, dtype=means.dtype), 1.0
    for n in order.tolist():
        offset = centres[n] - pixels
        power = -0.5 * ((offset @ conic[n]) * offset).sum(2)
        alpha = alphas[n] * (torch.exp(power) if falloffs is None else falloffs.setdefault(n, torch.exp(power)))
        alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
        image = image + (left_over * alpha)[:, :, None] * colours[n]
        left_over = left_over * (1 - alpha)
    return (image + left_over[:, :, None] * camera.bg_color).permute(2, 0, 1), centres


class Rasterize(torch.autograd.Function):
    """As a caller in the backend's shape uses it: buffers through save_for_backward, settings and numbers beside."""

    @staticmethod
    def forward(ctx, means, scales, rotations, opacities, first, rest, info, camera):
        image, *buffers, instances, buckets, selector = fastergs.forward(
            means, scales, rotations, opacities, first, rest, *camera
        )
        ctx.numbers, ctx.camera, ctx.info = (instances, buckets, selector), camera, info
        ctx.save_for_backward(image, means, scales, rotations, opacities, rest, *buffers)
        return image

    @staticmethod
    def backward(ctx, gradient):
        gradients = fastergs.backward(ctx.info, gradient, *ctx.saved_tensors, *ctx.camera, *ctx.numbers)
        return (*gradients, None, None)


def run(raw, camera, info=None):
    leaves = [tensor.clone().requires_grad_() for tensor in raw]
    image = Rasterize.apply(*leaves, torch.empty(0) if info is None else info, camera)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(5))
    (image * weights).sum().backward()
    return image.detach(), [leaf.grad for leaf in leaves], weights


def assert_close(got, wanted, tolerance):
    for name, g, w in zip(NAMES, got, wanted):
        assert (g.double() - w).norm() <= tolerance * w.norm(), name
        assert (g.double() * w).sum() > 0.9999 * g.norm() * w.norm(), name


class TestRasterizer:
    @pytest.mark.parametrize("bases", [1, 4, 9, 16])
    def test_its_formulas(self, bases):
        raw = scene(30 if bases > 1 else 200, faint=bases == 1)
        raw[0] *= 0.35  # within the guard: beyond it the gradient along the depth is 3DGS's, twice FasterGS's in part
        image, gradients, weights = run(raw, settings(bases=bases))
        leaves = [tensor.double().requires_grad_() for tensor in raw]
        expected, _ = written_out(leaves, settings(bases=bases, dtype=torch.float64))
        (expected * weights).sum().backward()
        torch.testing.assert_close(image.double(), expected.detach(), atol=1e-4, rtol=0)
        assert not gradients[5][:, bases - 1 :].any()
        expected_gradients = [leaf.grad for leaf in leaves]
        if bases == 1:
            gradients, expected_gradients = gradients[:5], expected_gradients[:5]
        assert_close(gradients, expected_gradients, 1e-3)

    @pytest.mark.parametrize(("near", "far"), [(0.01, 1000.0), (2.5, 3.3)])
    def test_near_and_far(self, near, far):
        raw = scene(faint=True)
        image, gradients, weights = run(raw, settings(near=near, far=far))
        leaves = [tensor.double().requires_grad_() for tensor in raw]
        expected, _ = written_out(leaves, settings(near=near, far=far, dtype=torch.float64))
        (expected * weights).sum().backward()
        torch.testing.assert_close(image.double(), expected.detach(), atol=1e-4, rtol=0)
        assert_close(gradients, [leaf.grad for leaf in leaves], 1e-3)

    def test_none_in_sight(self):
        raw = scene()
        raw[0] -= 100 * settings().w2c[2, :3]
        info = torch.zeros(2, 40)
        image, gradients, _ = run(raw, settings(), info)
        assert torch.equal(image, settings().bg_color[:, None, None].expand_as(image))
        assert not any(gradient.any() for gradient in gradients) and not info.any()

    def test_what_densification_reads(self):
        raw = scene(60, faint=True)
        raw[0] *= 2
        info = torch.full((2, 60), 3.0)
        _, _, weights = run(raw, settings(), info)
        leaves = [tensor.double().requires_grad_() for tensor in raw]
        expected, centres = written_out(leaves, settings(dtype=torch.float64))
        (expected * weights).sum().backward()
        half = torch.tensor([25.0, 17.0])
        lengths = (centres.grad * half).norm(dim=1)
        torch.testing.assert_close(info[1].double() - 3, lengths, atol=1e-3, rtol=1e-3)
        seen = info[0] == 4
        assert set(info[0].tolist()) == {3.0, 4.0}
        assert (lengths[~seen] == 0).all()
        assert (lengths[seen] > 0).float().mean() > 0.95  # but for some that only their box's corner is in sight of

    def test_where_the_principal_point_is_off_centre(self):
        # FasterGS's guard, where a projection is linearised, moves with the principal point; 3DGS's does not.
        raw = scene(30)
        image, _, _ = run(raw, settings(shift=0.5))
        expected, _ = written_out([t.double() for t in raw], settings(shift=0.5, dtype=torch.float64))
        assert 1e-4 < (image.double() - expected).abs().max() < 0.01

    def test_where_opaque_ones_differ(self):
        # FasterGS has no ceiling of alpha; the rasterizer here stops at 0.99: one hundredth of what is behind shows.
        raw = [tensor[:1] for tensor in scene()]
        raw[0][:], raw[1][:], raw[3][:] = 0, -1.0, 12.0
        image, _, _ = run(raw, settings(bases=1))
        expected, _ = written_out([t.double() for t in raw], settings(bases=1, dtype=torch.float64))
        worst = (image.double() - expected).abs().max()
        colour = (0.28209479177387814 * raw[4][0, 0] + 0.5).clamp_min(0)
        contrast = (colour - settings().bg_color).abs().max()
        assert 0.005 * contrast < worst < 0.01 * contrast

    def test_inference(self):
        raw = scene()
        raw[4] *= 3
        camera = settings()
        image, _, _ = run(raw, camera)
        assert image.max() > 1
        assert torch.equal(fastergs.inference(*raw, *camera, True, False), image)
        assert torch.equal(fastergs.inference(*raw, *camera, False, True), image.clamp(0, 1).permute(1, 2, 0))

    def test_proper_antialiasing(self):
        raw = scene(30, faint=True)
        raw[0] *= 0.35
        raw[1] -= 1.5  # small enough to be dimmed much
        image, gradients, weights = run(raw, settings(antialiasing=True))
        leaves = [tensor.double().requires_grad_() for tensor in raw]
        expected, _ = written_out(leaves, settings(antialiasing=True, dtype=torch.float64))
        (expected * weights).sum().backward()
        torch.testing.assert_close(image.double(), expected.detach(), atol=2e-5, rtol=0)
        assert_close(gradients, [leaf.grad for leaf in leaves], 2e-3)
        assert (image - run(raw, settings())[0]).abs().max() > 0.01

    @pytest.mark.parametrize("antialiasing", [False, True])
    def test_pruning_scores(self, antialiasing):
        raw, camera = scene(25, faint=True), settings(antialiasing=antialiasing, dtype=torch.float64)
        scores = torch.full((25, 1), 2.0)
        fastergs.pruning_scores(scores, *raw, *settings(antialiasing=antialiasing))
        falloffs = {}
        doubled = [tensor.double() for tensor in raw]
        written_out(doubled, camera, falloffs)
        leaves = {n: falloff.requires_grad_() for n, falloff in falloffs.items()}
        image, _ = written_out(doubled, camera, leaves)
        image.sum().backward()
        expected = torch.full((25,), 2.0, dtype=torch.float64)
        for n, leaf in leaves.items():
            expected[n] += leaf.grad.square().sum()
        assert (expected > 2.5).sum() > 5
        torch.testing.assert_close(scores[:, 0].double(), expected, rtol=1e-3, atol=1e-3)

    def test_values_that_are_not_finite(self):
        raw = scene()
        raw[1][3, 0] = math.nan
        with pytest.raises(LegsError, match=r"forward: scales \[40, 3\] holds NaN"):
            fastergs.forward(*raw, *settings())


class TestAdam:
    @pytest.mark.parametrize("betas", [(0.9, 0.999), (0.5, 0.9)])
    def test_torchs(self, betas):
        generator = torch.Generator().manual_seed(0)
        start = torch.randn(20, 3, generator=generator, dtype=torch.float64)
        theirs = start.clone().requires_grad_()
        optimizer = torch.optim.Adam([theirs], lr=0.01, betas=betas, eps=1e-15)
        ours, first, second = start.clone(), torch.zeros_like(start), torch.zeros_like(start)
        for step in range(1, 40):
            gradient = torch.randn(20, 3, generator=generator, dtype=torch.float64)
            if step == 7:
                gradient[:5] = 0
            theirs.grad = gradient.clone()
            optimizer.step()
            fastergs.adam_step(gradient, ours, first, second, step, 0.01, *betas, 1e-15)
            torch.testing.assert_close(ours, theirs.detach(), rtol=1e-12, atol=1e-14)

    def test_a_parameter(self):
        parameter = torch.nn.Parameter(torch.ones(3))
        fastergs.adam_step(torch.ones(3), parameter, torch.zeros(3), torch.zeros(3), 1, 0.1, 0.9, 0.999, 1e-15)
        torch.testing.assert_close(parameter.detach(), torch.full((3,), 0.9))


class TestDensification:
    def test_relocation(self):
        opacities = torch.tensor([[0.1], [0.5], [0.9], [0.99]])
        scales = torch.tensor([[1.0, 2.0, 3.0]]).repeat(4, 1)
        for copies in (1, 2, 5, 60):
            new, smaller = fastergs.relocation_adjustment(opacities, scales, torch.full((4,), copies))
            n = min(copies, 50)
            for index, old in enumerate(opacities[:, 0].double().tolist()):
                each = 1 - (1 - old) ** (1 / n)
                assert new[index, 0].item() == pytest.approx(each, rel=1e-5)
                denominator = sum(
                    math.factorial(i - 1)
                    // math.factorial(k)
                    // math.factorial(i - 1 - k)
                    * (-1) ** k
                    / math.sqrt(k + 1)
                    * new[index, 0].item() ** (k + 1)
                    for i in range(1, n + 1)
                    for k in range(i)
                )
                torch.testing.assert_close(smaller[index], (old / denominator) * scales[index], rtol=2e-3, atol=0)
        one, same = fastergs.relocation_adjustment(opacities, scales, torch.ones(4, dtype=torch.int64))
        torch.testing.assert_close(one, opacities)
        torch.testing.assert_close(same, scales)

    def test_noise(self):
        means, scales, rotations, opacities, *_ = scene(30)
        opacities[:15] = 9.0
        rotations[29] = 0
        noise = torch.randn(30, 3, generator=torch.Generator().manual_seed(3))
        moved = means.clone()
        fastergs.add_noise(scales, rotations, opacities, noise, moved, 0.5)
        assert torch.equal(moved[:15], means[:15]) and torch.equal(moved[29], means[29])
        w, x, y, z = torch.nn.functional.normalize(rotations[20], dim=0).tolist()
        turn = torch.tensor(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        covariance = turn @ torch.diag((2 * scales[20]).exp()) @ turn.T
        strength = 0.5 / (1 + math.exp(100 * torch.sigmoid(opacities[20]).item() - 0.5))
        torch.testing.assert_close(moved[20], means[20] + strength * covariance @ noise[20])

    def test_3d_filter(self):
        camera = settings()
        points = torch.cat([scene(200)[0], torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -50.0]])])
        sizes, seen = torch.full((202, 1), 0.05), torch.zeros(202, 1, dtype=torch.bool)
        fastergs.update_3d_filter(points, camera.w2c, sizes, seen, 50, 34, 45.0, 47.0, 25.3, 16.3, 0.2, 0.15, 0.01)
        for point, size, mark in zip(points.double().numpy(), sizes[:, 0].tolist(), seen[:, 0].tolist()):
            x, y, z = camera.w2c.double().numpy()[:3] @ np.append(point, 1)
            u, v = 45 * x / z + 25.3, 47 * y / z + 16.3
            shown = z >= 0.2 and -7.5 <= u <= 57.5 and -5.1 <= v <= 39.1
            assert mark == (shown and 0.01 * z <= 0.05)
            assert size == pytest.approx(0.01 * z if mark else 0.05, rel=1e-4)
        assert seen.any() and not seen.all()


class TestMorton:
    def test_interleaved_bits(self):
        points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
        points[0], points[1] = 0, 1
        codes = morton_encode(points)
        least, most = points.min(0).values.numpy(), points.max(0).values.numpy()
        assert codes.dtype == torch.int64 and codes[0] == 0 and codes[1] == 2**63 - 1
        for point, code in zip(points.numpy(), codes.tolist()):
            steps = ((point - least) / np.float32((most - least).max()) * np.float32(2**21 - 1)).astype(np.int64)
            expected = sum(
                ((int(step) >> bit) & 1) << (3 * bit + axis) for axis, step in enumerate(steps) for bit in range(21)
            )
            assert abs(expected - code) < 2**12  # rounding of the coordinates' last bits

    def test_flat_and_single(self):
        assert morton_encode(torch.ones(1, 3)).tolist() == [0]
        flat = torch.rand(10, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.0])
        assert (morton_encode(flat) >= 0).all()


class TestModule:
    def test_packages(self):
        shims = {name: build(name, table_for()[name]) for name in ("FasterGSCudaBackend", "MortonEncoding")}
        assert shims["FasterGSCudaBackend"]._C.forward is fastergs.forward
        assert shims["FasterGSCudaBackend"]._C.adam_step is fastergs.adam_step
        assert shims["MortonEncoding"]._C.morton_encode is morton_encode
        with pytest.raises(MissingShim, match=r"MortonEncoding\._C\.decode"):
            shims["MortonEncoding"]._C.decode  # noqa: B018

    def test_ppisp_can_only_be_imported(self):
        package = build("ppisp", table_for()["ppisp"])
        assert package.report.export_ppisp_report
        with pytest.raises(MissingShim, match=r"ppisp\.PPISPConfig"):
            package.PPISPConfig(use_controller=True)

    def test_graphs_go_with_their_buffers(self):
        import gc
        import weakref

        image, *buffers, _, _, _ = fastergs.forward(*scene(), *settings())
        kept = weakref.ref(buffers[0].kept.visible)
        assert not image.requires_grad
        del buffers
        gc.collect()
        assert kept() is None
