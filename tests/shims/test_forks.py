"""A fork's rasterizer, made from the arguments that its code passes and the results that it unpacks."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("numba")
pytest.importorskip("scipy")

from legs_adapters.shims.inria import forks
from legs_adapters.shims.inria.survey import Interface, InterfaceCall
from legs_adapters.shims.missing import MissingShim

from tests.lab import oracle
from tests.shims.support import BACKGROUND, Dense, camera, close, gaussians, view_of


def forked(results, extra=(), **more):
    """Draw with a generic stand-in whose caller unpacks these names."""
    interface = Interface()
    interface.fields = list(extra)
    lines = (forked_call.__code__.co_firstlineno, forked_call.__code__.co_firstlineno + 20)
    interface.calls = [InterfaceCall(__file__, *lines, tuple(results))]
    module = forks.module("diff_fork", interface)
    given, fields = gaussians(), camera()
    settings = module.GaussianRasterizationSettings(**fields, **more)
    return forked_call(module.GaussianRasterizer(settings), given), Dense(given, fields), given, fields


def forked_call(rasterizer, given, **more):
    return rasterizer(means2D=torch.zeros(len(given["means3D"]), 3, requires_grad=True), **given, **more)


class TestForks:
    def test_names(self):
        names = ("rendered_depth", "acc", "image", "radii", "rendered_invdepth", "pixels", "gs_w", "accum_max_count")
        (depth, alpha, image, radii, inverse, pixels, weights, most), dense, given, _ = forked(names)
        shape = (1, *dense.shape)
        close(image, dense.image)
        close(depth, (dense.weights @ dense.depths).reshape(shape))
        close(inverse, (dense.weights @ (1 / dense.depths)).reshape(shape))
        close(alpha, dense.weights.sum(1).reshape(shape))
        count = len(given["means3D"])
        close(pixels[:, 0], dense.per_gaussian((dense.weights > 0).double(), count))
        close(weights, dense.per_gaussian(dense.weights, count))
        largest = dense.weights.max(1)
        one = torch.nn.functional.one_hot(largest.indices, len(dense.order)) * (largest.values > 0)[:, None]
        assert float((most - dense.per_gaussian(one.double(), count)).abs().max()) <= 2  # ties may go either way
        assert radii.dtype == torch.int32

    def test_inria_s_later_rasterizer_returns_inverse_depth(self):
        (image, _, depth), dense, _, _ = forked(("image", "radii", "depth"), ("antialiasing",), antialiasing=False)
        close(image, dense.image)
        close(depth, (dense.weights @ (1 / dense.depths)).reshape(1, *dense.shape))

    def test_antialiasing_dims_by_as_much_as_the_dilation_widened(self):
        (image, _), _, given, fields = forked(("image", "radii"), ("antialiasing",), antialiasing=True)
        view = view_of(fields)
        to_camera = torch.as_tensor(view.world_to_camera)
        points = given["means3D"].double() @ to_camera[:3, :3].T + to_camera[:3, 3]
        conics = oracle.project(points, given["scales"].double(), given["rotations"].double(), view).conics
        covariance = torch.linalg.inv(torch.stack([conics[:, [0, 1]], conics[:, [1, 2]]], 1))
        before = torch.linalg.det(covariance - 0.3 * torch.eye(2))
        ratio = (before / torch.linalg.det(covariance)).clamp_min(0.000025).sqrt()
        close(image, Dense(dict(given, opacities=given["opacities"] * ratio[:, None]), fields).image, 5e-4)

    def test_the_gradient_of_scores_is_a_sum_of_squares(self):
        # Of one Gaussian, d image / d falloff is its opacity times its colour's distance from the background.
        module, given, fields = forks.module("diff_fork", Interface()), gaussians(1, seed=3), camera()
        scores = torch.zeros(1, 1, requires_grad=True)
        rasterizer = module.GaussianRasterizer(module.GaussianRasterizationSettings(**fields))
        image, _ = forked_call(rasterizer, given, scores=scores)
        weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
        (image * weights).sum().backward()
        dense = Dense(given, fields)
        drawn = (dense.weights[:, 0] > 0).reshape(dense.shape)
        assert drawn.sum() > 50
        at = int(dense.weights.argmax())
        away = (dense.image.reshape(3, -1)[:, at] - BACKGROUND.double()) / dense.weights[at, 0]
        slopes = given["opacities"].double() * (weights.double() * away[:, None, None]).sum(0)
        assert scores.grad.item() == pytest.approx(slopes[drawn].square().sum().item(), rel=1e-3)

    def test_a_gradient_through_depth(self):
        (_, depth, _), dense, given, _ = forked(("image", "rendered_depth", "radii"))
        del dense
        given["means3D"].requires_grad_(True)
        (_, depth, _) = forked(("image", "rendered_depth", "radii"))[0]
        assert depth.requires_grad is False  # nothing that was given asked for one

    @pytest.mark.parametrize(
        ("extra", "more", "named"),
        [
            (("mode",), {"mode": 2}, "GaussianRasterizationSettings(mode=...)"),
            (("confidence",), {"confidence": torch.tensor([1.0, 0.5])}, "GaussianRasterizationSettings(confidence"),
        ],
    )
    def test_settings_that_are_not_known_are_errors(self, extra, more, named):
        with pytest.raises(MissingShim) as caught:
            forked(("image", "radii"), extra, **more)
        assert named in str(caught.value)

    def test_settings_that_change_nothing_are_not(self):
        forked(("image", "radii"), ("mode", "confidence"), mode=None, confidence=torch.ones(3))

    def test_an_unknown_result_is_an_error_where_it_is_used(self):
        (_, _, flow), _, _, _ = forked(("image", "radii", "out_flow"))
        uses = (lambda: flow + 1, lambda: flow.mean(), lambda: flow[0], lambda: torch.mean(flow), lambda: 2 * flow)
        for use in uses:
            with pytest.raises(MissingShim, match="out_flow"):
                use()
