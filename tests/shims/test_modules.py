"""The small compiled modules: neighbours, scattering, fused SSIM, sparse Adam, torchvision, LPIPS."""

from __future__ import annotations

import importlib
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_adapters.shims import finder
from legs_adapters.shims.finder import build, table_for
from legs_adapters.shims.inria import forks, taming
from legs_adapters.shims.inria.relocation import compute_relocation
from legs_adapters.shims.inria.sparse_adam import SparseGaussianAdam
from legs_adapters.shims.inria.survey import Interface, InterfaceCall
from legs_adapters.shims.missing import MissingShim
from legs_adapters.shims.modules import diff_gaussian_rasterization as inria
from legs_adapters.shims.modules import fused_ssim, lpips, simple_knn, torch_scatter, torchvision

from legs_loss import ssim
from legs_loss.counting import counted
from tests.shims.support import Dense, camera, close, draw, gaussians
from tests.support import ROOT


class Distance(torch.nn.Module):
    def __init__(self, power, scale):
        super().__init__()
        self.power, self.scale = power, scale

    def forward(self, x, y):
        return self.scale * (x - y).abs().pow(self.power).mean((1, 2, 3))


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
        with pytest.raises(MissingShim, match=r"diff_fork\.GaussianRasterizer\.integrate has no shim"):
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
        wanted = ssim(first, second, padding=ours)
        wanted.backward()
        assert found.item() == pytest.approx(wanted.item(), abs=1e-5)
        close(gradient, first.grad, 1e-3)

    def test_fused_ssim_is_no_step_of_the_loss(self):
        first, second = torch.rand(2, 1, 3, 30, 40).unbind(0)
        before = replace(counted)
        fused_ssim.fused_ssim(first.requires_grad_(True), second).backward()
        assert counted == before

    def test_fused_ssim_is_the_same_with_legs_off(self, monkeypatch):
        # `legs-patch --verify` compares the unpatched losses with those of LEGS_OFF=1, to the last bit.
        first, second = torch.rand(2, 1, 3, 30, 40).unbind(0)
        first.requires_grad_(True)
        on = fused_ssim.fused_ssim(first, second)
        monkeypatch.setenv("LEGS_OFF", "1")
        assert torch.equal(fused_ssim.fused_ssim(first, second), on)

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

    def test_every_shim_can_be_built_under_its_name_and_is_documented(self):
        page = (ROOT / "docs" / "cpu.md").read_text(encoding="utf-8")
        for name, shim in table_for().items():
            assert build(name, shim).__name__ == name
            assert f"`{name}" in page
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
        plain.calls = [InterfaceCall("a.py", 1, 2, ("image", "radii"))]
        more.calls = [InterfaceCall("a.py", 1, 2, ("image", "radii", "depth"))]
        scored.fields = ["pixel_weights"]
        name = "diff_gaussian_rasterization"
        for interface, home in ((plain, inria), (more, forks), (scored, taming)):
            table = table_for({name: interface, "diff_other": interface})
            assert build(name, table[name]).__doc__ == home.__doc__
            assert build("diff_other", table["diff_other"]).__doc__ == forks.__doc__
