"""FLIP, GMSD and HaarPSI as metrics of a comparison: ends of their scales, order, and tables without them."""

from __future__ import annotations

import importlib.util
import sys

import pytest
import torch

from legs_loss.experiments.tables import MISSING, with_values
from legs_loss.reference.training.metrics import METRICS, left_out, score

pytest.importorskip("numba")

KEYS = {"flip": 0.0, "gmsd": 0.0, "haarpsi": 1.0}  # and what equal images have


def need(key: str) -> None:
    if not METRICS[key].available():  # type: ignore[misc]
        pytest.skip(f"what {key} needs is not installed")


@pytest.mark.parametrize("key", KEYS)
def test_more_noise_is_further_from_the_photograph(key: str) -> None:
    need(key)
    generator = torch.Generator().manual_seed(0)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 8, 8, generator=generator), (64, 48), mode="bilinear")[0]
    noise = torch.randn(image.shape, generator=generator)
    values = [METRICS[key].compute((image + scale * noise).clamp(0, 1), image) for scale in (0.0, 0.02, 0.1, 0.3)]
    assert values[0] == pytest.approx(KEYS[key], abs=1e-5)
    ordered = sorted(values, reverse=key == "haarpsi")
    assert values == ordered and len(set(values)) == 4
    assert score((image + 0.1 * noise), image)[key] == pytest.approx(values[2])
    assert key not in score(image, image, "train")


def test_gmsd_by_its_formula() -> None:
    need("gmsd")
    from scipy.ndimage import convolve

    generator = torch.Generator().manual_seed(1)
    images = [torch.rand(1, 32, 32, generator=generator).expand(3, 32, 32).contiguous() for _ in range(2)]
    filters = torch.tensor([[1.0, 0.0, -1.0]] * 3).numpy() / 3

    def gradients(image):
        half = torch.nn.functional.avg_pool2d(image[:1], 2)[0].double().numpy()  # gray: luma is the value itself
        return (convolve(half, filters, mode="constant") ** 2 + convolve(half, filters.T, mode="constant") ** 2) ** 0.5

    first, second = map(gradients, images)
    constant = 170 / 255**2
    similarity = (2 * first * second + constant) / (first**2 + second**2 + constant)
    assert METRICS["gmsd"].compute(*images) == pytest.approx(similarity.std(), abs=2e-2)


def test_piq_itself_is_left_as_it_was() -> None:
    need("gmsd")
    METRICS["gmsd"].compute(torch.rand(3, 32, 32), torch.rand(3, 32, 32))
    assert "piq" not in sys.modules or importlib.util.find_spec("torchvision") is not None


def test_what_is_left_out_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in ("flip", "gmsd", "haarpsi", "lpips"):
        monkeypatch.setitem(METRICS, key, METRICS[key]._replace(available=lambda key=key: key == "flip"))  # type: ignore[misc]
    said = left_out()
    assert said.startswith("Left out: GMSD, HaarPSI (pip install 'legs-loss[metrics]'); LPIPS (pip install lpips")
    assert "nothing is downloaded" in said and "\n" not in said
    for key in ("gmsd", "haarpsi", "lpips"):
        monkeypatch.setitem(METRICS, key, METRICS[key]._replace(available=lambda: True))
    assert left_out() == ""


def test_a_column_that_no_row_has_is_left_out() -> None:
    heads = ["arm", "held-out PSNR", METRICS["flip"].column("test")]
    assert with_values(heads, [["a", MISSING, MISSING]]) == (heads[:2], [["a", MISSING]])
    assert with_values(heads, [["a", MISSING, MISSING], ["b", "1", "0.1"]])[0] == heads
    cells = [[("a", "a"), ("1", "1"), (MISSING, "")]]
    assert with_values(heads, cells) == (heads[:2], [cells[0][:2]])
