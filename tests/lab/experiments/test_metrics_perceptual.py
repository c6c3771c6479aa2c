"""LPIPS as a metric of a comparison, and tables without it."""

from __future__ import annotations

import pytest
import torch

from legs_loss.lab.experiments.tables import MISSING, with_values
from legs_loss.lab.training.metrics import METRICS, left_out, score

pytest.importorskip("numba")


def test_it_is_computed_of_held_out_views_where_it_is_available(monkeypatch: pytest.MonkeyPatch) -> None:
    image = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    difference = METRICS["lpips"]._replace(compute=lambda first, second: 0.25, available=lambda: True)
    monkeypatch.setitem(METRICS, "lpips", difference)  # type: ignore[misc]
    assert score(image, image)["lpips"] == 0.25
    assert "lpips" not in score(image, image, "train")
    assert left_out() == ""
    monkeypatch.setitem(METRICS, "lpips", difference._replace(available=lambda: False))  # type: ignore[misc]
    assert "lpips" not in score(image, image)
    assert left_out().startswith("Left out: LPIPS (pip install lpips") and "nothing is downloaded" in left_out()


def test_a_column_that_no_row_has_is_left_out() -> None:
    heads = ["arm", "held-out PSNR", METRICS["lpips"].column("test")]
    assert with_values(heads, [["a", MISSING, MISSING]]) == (heads[:2], [["a", MISSING]])
    assert with_values(heads, [["a", MISSING, MISSING], ["b", "1", "0.1"]])[0] == heads
    cells = [[("a", "a"), ("1", "1"), (MISSING, "")]]
    assert with_values(heads, cells) == (heads[:2], [cells[0][:2]])
