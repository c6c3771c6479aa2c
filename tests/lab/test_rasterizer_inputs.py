"""Inputs of the rasterizers, accepted and refused: strides, dtypes, options, cameras; no numba, no cache."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from legs_loss.errors import LegsError
from legs_loss.lab.rasterizer import rasterize
from tests.lab.rasterizing import BACKGROUND, NAMES, camera, run, scene


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
    def test_a_wrong_shape_names_all_of_them(self, index):
        inputs = scene()
        inputs[index] = inputs[index][:, :-1] if index < 4 else inputs[index][:-1]
        with pytest.raises(
            LegsError, match=r"of the wrong shape among means \[.*scales \[.*opacities \[.*sh \["
        ) as error:
            rasterize(*inputs, camera(), BACKGROUND, 3)
        assert str(error.value).startswith(NAMES[index] if index else "means")

    @pytest.mark.parametrize("index", range(5))
    @pytest.mark.parametrize("value", [float("nan"), float("inf")])
    def test_a_value_that_is_not_a_number(self, index, value):
        inputs = scene()
        inputs[index].view(40, -1)[7, -1] = value
        with pytest.raises(LegsError, match=rf"{NAMES[index]} \[40, .* in 1 of its 40 rows, first in row 7"):
            rasterize(*inputs, camera(), BACKGROUND, 3)

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
        ],
    )
    def test_wrong_options(self, options, message):
        arguments = {"background": BACKGROUND, "sh_degree": 3, **options}
        with pytest.raises(LegsError, match=message):
            rasterize(*scene(), camera(), **arguments)

    def test_too_few_coefficients(self):
        with pytest.raises(LegsError, match="needs K >= 16 coefficients; sh has 9"):
            rasterize(*scene(degree=2), camera(), BACKGROUND, 3)

    @pytest.mark.parametrize("index", range(6))
    def test_only_float32_on_the_cpu(self, index):
        inputs = [*scene(), torch.zeros(40, 2)]
        for other, found in ((inputs[index].double(), "float64 on cpu"), (inputs[index].to("meta"), "float32 on meta")):
            wrong = [*inputs[:index], other, *inputs[index + 1 :]]
            with pytest.raises(LegsError, match=rf"{NAMES[index]} is torch\.{found}; .* takes float32 on the CPU"):
                rasterize(*wrong[:5], camera(), BACKGROUND, 3, wrong[5])

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
        from legs_loss.lab.rasterizer import sorting

        firsts, reached = sorting.make_slots(np.empty((0, 4), np.int32), np.empty(0, np.int64), 32)
        nothing = np.empty(0, np.float32), firsts, reached
        with pytest.raises(LegsError, match="2048 x 257 strips cannot be drawn"):  # 16384 x 8224 pixels
            sorting.sort_entries(*nothing, 2048, 257)
        sorting.sort_entries(*nothing, 2048, 256)

    def test_without_numba(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "numba", None)
        with pytest.raises(LegsError, match=r"needs numba: pip install numba, or, .* '\.\[cpu\]'"):
            rasterize(*scene(), camera(), BACKGROUND, 3)
