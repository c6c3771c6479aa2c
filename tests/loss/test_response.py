"""The response against scipy.ndimage, hand-worked stencils, and its symmetries."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from legs_loss import LegsError, response
from legs_loss.operators import OPERATORS
from legs_loss.responses import normalise_response
from tests.strategies import images

ndimage_mode = "mirror"  # what torch calls reflect: the edge pixel is not repeated


def dot(size=5, channels=1):
    image = torch.zeros(channels, size, size)
    image[:, size // 2, size // 2] = 1.0
    return image


def planar(image, *settings, **named):
    """Return the response of an image [C, H, W] of any size: a tiny one does not show its layout."""
    return response(image, *settings, channels_last=False, **named)


class TestValues:
    def test_four_neighbours_by_hand(self):
        expected = torch.tensor(
            [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [0, 1, 4, 1, 0], [0, 0, 1, 0, 0], [0, 0, 0, 0, 0]]
        ).float()
        assert torch.equal(planar(dot())[0], expected)

    def test_eight_neighbours_by_hand(self):
        expected = torch.tensor(
            [[0, 0, 0, 0, 0], [0, 1, 1, 1, 0], [0, 1, 8, 1, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]]
        ).float()
        assert torch.equal(planar(dot(), "laplacian8")[0], expected)

    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_eight_neighbours_equal_kornia(self, p):
        filters = pytest.importorskip("kornia.filters")
        image = torch.rand(2, 3, 17, 23, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        channels = filters.laplacian(image, 3, border_type="reflect", normalized=False)
        expected = torch.linalg.vector_norm(channels, p, dim=1, keepdim=True)
        torch.testing.assert_close(planar(image, "laplacian8", p), expected)

    @pytest.mark.parametrize("p", [1.0, 2.0, float("inf")])
    def test_sobel_equals_kornia_inside(self, p):
        filters = pytest.importorskip("kornia.filters")
        image = torch.rand(1, 3, 17, 23, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        # kornia's border is replicated, so that only the inside is the same.
        slopes = filters.spatial_gradient(image, "sobel", normalized=False)[:, :, :, 1:-1, 1:-1]
        expected = torch.linalg.vector_norm(slopes.flatten(1, 2), p, dim=1, keepdim=True)
        torch.testing.assert_close(planar(image, "sobel", p)[..., 1:-1, 1:-1], expected)

    def test_three_by_three_with_reflected_border_by_hand(self):
        image = torch.tensor([[[1.0, 2.0, 4.0], [3.0, 5.0, 7.0], [6.0, 8.0, 9.0]]])
        # Corner (0, 0): up and down are both 3, left and right both 2: 3 + 3 + 2 + 2 - 4 * 1 = 6.
        # Centre: 2 + 8 + 3 + 7 - 20 = 0. Edge (0, 1): 5 + 5 + 1 + 4 - 8 = 7.
        result = planar(image)[0]
        assert [float(result[0, 0]), float(result[1, 1]), float(result[0, 1])] == [6.0, 0.0, 7.0]

    def test_three_by_three_central_differences_by_hand(self):
        image = torch.tensor([[[1.0, 2.0, 4.0], [3.0, 5.0, 7.0], [6.0, 8.0, 9.0]]])
        # Centre: (7 - 3) / 2 = 2 across, (8 - 2) / 2 = 3 down.
        assert float(planar(image, "central", 1)[0, 1, 1]) == 5.0
        assert float(planar(image, "central", 2)[0, 1, 1]) == pytest.approx(13**0.5)
        assert float(planar(image, "central", float("inf"))[0, 1, 1]) == 3.0
        assert float(planar(image, "central")[0, 0, 0]) == 0.0

    @pytest.mark.parametrize(("p", "expected"), [(1, 3.5 * 4), (2, 12.25**0.5 * 4), (float("inf"), 12.0)])
    def test_norm_over_channels_by_hand(self, p, expected):
        image = dot(3, 3) * torch.tensor([3.0, 0.5, 0.0]).reshape(3, 1, 1)
        if p == 2:
            expected = (9.0 + 0.25) ** 0.5 * 4
        assert float(planar(image, p=p)[0, 1, 1]) == pytest.approx(expected)

    def test_smooth_ramp_has_no_laplacian_inside(self):
        ramp = torch.arange(8.0).expand(3, 8, 8)
        assert float(planar(ramp)[0, :, 1:-1].max()) == 0.0
        assert torch.equal(planar(ramp, "central")[0, :, 1:-1], torch.full((8, 6), 3.0**0.5))


class TestAgainstScipy:
    @settings(max_examples=40, deadline=None)
    @given(images())
    def test_laplacian(self, image):
        per_channel = np.stack([ndimage.laplace(c.numpy(), mode=ndimage_mode) for c in image])
        np.testing.assert_allclose(planar(image)[0].numpy(), np.sqrt((per_channel**2).sum(0)), atol=1e-12)

    @settings(max_examples=40, deadline=None)
    @given(images(), st.sampled_from([1, 2, np.inf]))
    def test_sobel(self, image, p):
        parts = [ndimage.sobel(c.numpy(), axis=a, mode=ndimage_mode) for c in image for a in (0, 1)]
        expected = np.linalg.norm(np.stack(parts).reshape(len(parts), -1), ord=p, axis=0)
        np.testing.assert_allclose(planar(image, "sobel", p).numpy().ravel(), expected, atol=1e-12)

    @settings(max_examples=20, deadline=None)
    @given(images())
    def test_scharr_and_eight_neighbours(self, image):
        kernel = np.array([[3, 0, -3], [10, 0, -10], [3, 0, -3]], float)
        eight = np.array([[1, 1, 1], [1, -8, 1], [1, 1, 1]], float)
        convolved = [ndimage.convolve(c.numpy(), k, mode=ndimage_mode) for c in image for k in (kernel, kernel.T)]
        np.testing.assert_allclose(planar(image, "scharr")[0], np.sqrt((np.stack(convolved) ** 2).sum(0)), atol=1e-11)
        convolved = [ndimage.convolve(c.numpy(), eight, mode=ndimage_mode) for c in image]
        expected = np.sqrt((np.stack(convolved) ** 2).sum(0))
        np.testing.assert_allclose(planar(image, "laplacian8")[0], expected, atol=1e-12)

    @settings(max_examples=10, deadline=None)
    @given(images())
    @pytest.mark.parametrize("operator", OPERATORS.values(), ids=tuple(OPERATORS))
    def test_every_record_is_what_is_computed(self, operator, image):
        for stencil in operator.stencils:
            assert sum(map(sum, stencil)) == pytest.approx(0.0, abs=1e-12)
            assert len(stencil) == 2 * operator.reach + 1 == len(stencil[0])
        parts = [
            ndimage.correlate(channel.numpy(), np.array(stencil, float), mode=ndimage_mode)
            for channel in image
            for stencil in operator.stencils
        ]
        np.testing.assert_allclose(planar(image, operator.name)[0], np.sqrt((np.stack(parts) ** 2).sum(0)), atol=1e-11)

    @pytest.mark.parametrize("operator", [name for name, record in OPERATORS.items() if record.reach > 0])
    def test_the_rows_of_a_large_image_that_are_worked_on_at_once_leave_no_seam(self, operator):
        image = torch.rand(3, 701, 301, generator=torch.Generator().manual_seed(0)).double()
        squares = sum(
            ndimage.correlate(channel, np.array(stencil, float), mode=ndimage_mode) ** 2
            for channel in image.numpy()
            for stencil in OPERATORS[operator].stencils
        )
        np.testing.assert_allclose(response(image, operator)[0].numpy(), np.sqrt(squares), atol=1e-12)


class TestSymmetries:
    @settings(max_examples=40, deadline=None)
    @given(images(), st.sampled_from(tuple(OPERATORS)), st.sampled_from([1, 2, float("inf")]))
    def test_flips_and_transposes_move_the_response_along(self, image, operator, p):
        result = planar(image, operator, p)
        close = dict(rtol=0, atol=1e-12)
        torch.testing.assert_close(planar(image.flip(-1), operator, p), result.flip(-1), **close)
        torch.testing.assert_close(planar(image.flip(-2), operator, p), result.flip(-2), **close)
        torch.testing.assert_close(planar(image.mT.contiguous(), operator, p), result.mT, **close)

    @settings(max_examples=40, deadline=None)
    @given(images(), st.floats(0.05, 4), st.sampled_from(tuple(OPERATORS)))
    def test_normalised_response_ignores_brightness_scale(self, image, scale, operator):
        first = normalise_response(planar(image, operator))
        second = normalise_response(planar(image * scale, operator))
        torch.testing.assert_close(first, second, rtol=0, atol=2e-6)  # eps by a small range

    @settings(max_examples=40, deadline=None)
    @given(images(), st.sampled_from(tuple(OPERATORS)))
    def test_normalised_response_is_in_the_unit_interval(self, image, operator):
        result = normalise_response(planar(image, operator))
        assert float(result.min()) == 0.0
        assert float(result.max()) <= 1.0

    @settings(max_examples=30, deadline=None)
    @given(st.floats(0, 1), st.integers(1, 9), st.integers(1, 9), st.sampled_from(tuple(OPERATORS)))
    def test_a_constant_image_has_none_at_all(self, value, height, width, operator):
        image = torch.full((3, height, width), value)
        assert float(planar(image, operator).max()) == 0.0
        assert float(normalise_response(planar(image, operator)).max()) == 0.0


class TestInputs:
    @pytest.mark.parametrize("operator", OPERATORS)
    def test_batch_is_each_image_by_itself(self, operator):
        batch = torch.rand(2, 3, 7, 5)
        batch[1] *= 0.1
        single = torch.stack([normalise_response(response(image, operator)) for image in batch])
        assert torch.equal(normalise_response(response(batch, operator)), single)
        assert response(batch, operator).shape == (2, 1, 7, 5)

    def test_channels_last(self):
        image = torch.rand(6, 7, 3)
        first = response(image.movedim(-1, 0))
        assert torch.equal(response(image), first.movedim(0, -1))
        batch = torch.rand(2, 6, 7, 3)
        assert response(batch).shape == (2, 6, 7, 1)

    def test_non_contiguous(self):
        image = torch.rand(3, 8, 12)[:, ::2, ::2]
        assert torch.equal(response(image), response(image.contiguous()))

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
    def test_float_types(self, dtype):
        image = (torch.rand(3, 6, 6) * 255).round().div(256).to(dtype)
        result = response(image)
        assert result.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
        torch.testing.assert_close(result.double(), response(image.double()), rtol=1e-6, atol=1e-6)

    def test_no_gradient_reaches_the_image(self):
        assert not response(torch.rand(3, 4, 5, requires_grad=True)).requires_grad

    @pytest.mark.parametrize(
        ("bad", "message"),
        [
            (torch.zeros(3, 4, 4, dtype=torch.uint8), "uint8.*255"),
            (torch.zeros(9, 4), r"\[9, 4\] is a list of pixels"),
            (torch.zeros(3, 0, 4), r"\[3, 0, 4\]"),
            (np.zeros((3, 4, 4)), "ndarray"),
        ],
    )
    def test_what_is_no_image_is_named(self, bad, message):
        with pytest.raises(LegsError, match=message):
            response(bad)

    def test_unknown_settings_list_what_there_is(self):
        with pytest.raises(LegsError, match="laplacian, laplacian8, sobel, scharr, central"):
            response(dot(), "canny")
        with pytest.raises(LegsError, match="1, 2 or inf"):
            response(dot(), p=3)
