"""Views that are out of focus or noisy beside the others are named by legs precompute and legs info."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from legs_loss.cli import main
from legs_loss.precompute.sharpness import outliers


def test_only_the_odd_ones_are_named() -> None:
    alike = {str(index): 0.1 + 0.001 * index for index in range(8)}
    assert outliers(alike) == []
    assert outliers({**alike, "a": 0.2, "b": 0.4}) == ["b", "a"]
    assert outliers({**alike, "flat": 0.001}) == []  # a sharp dot on a plain wall is no blur
    assert outliers({"a": 0.1, "b": 0.1, "c": 0.1, "d": 0.9}) == []  # too few to tell


def photograph(seed: int) -> Image.Image:
    """A picture of some rectangles, 160x120."""
    random = np.random.default_rng(seed)
    image = Image.new("RGB", (160, 120), (120, 120, 120))
    for _ in range(12):
        x, y, width, height = random.integers(0, 160), random.integers(0, 120), *(6 / random.uniform(0.05, 1, 2))
        image.paste(tuple(random.integers(60, 200, 3).tolist()), (x, y, x + int(width), y + int(height)))
    return image


@pytest.mark.parametrize(
    ("harm", "preset"),
    [("blur", "legs"), ("noise", "legs"), *((h, "legs-robust") for h in ("blur", "noise", "motion"))],
)
def test_a_harmed_photograph_is_named(tmp_path: Path, capsys: pytest.CaptureFixture, harm: str, preset: str) -> None:
    photographs = [tmp_path / "images" / f"{seed}.png" for seed in range(8)]
    photographs[0].parent.mkdir()
    for seed, path in enumerate(photographs):
        photograph(seed).save(path)
    scene = tmp_path
    command = ["precompute", str(scene), "--workers", "1", "--preset", preset]
    assert main(command) == 0
    assert "out of focus" not in capsys.readouterr().err
    harmed = photograph(3).filter(ImageFilter.GaussianBlur(3))
    if harm == "noise":
        pixels = np.asarray(harmed, float) + np.random.default_rng(0).normal(0, 20, (*harmed.size[::-1], 3))
        harmed = Image.fromarray(pixels.clip(0, 255).astype(np.uint8))
    if harm == "motion":
        harmed = photograph(3).filter(ImageFilter.BoxBlur(1))
    harmed.save(photographs[3])
    assert main(command) == 0
    said = capsys.readouterr().err
    assert "out of focus, moved or noisy" in said and photographs[3].name in said and photographs[4].name not in said
    assert main(["info", str(scene)]) == 0
    printed = capsys.readouterr().out
    assert f"unsharp    images/{photographs[3].name}" in printed
