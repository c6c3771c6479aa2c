"""CONTRIBUTING.md: what it names is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
NAMED = sorted(
    set(re.findall(r"(?<![\w/.])((?:legs_loss|adapters|tests|docs|benchmarks|examples)/[\w./-]*[\w/])", TEXT))
)


@pytest.mark.parametrize("path", NAMED)
def test_a_path_that_is_named_exists(path: str) -> None:
    assert (ROOT / path).exists()


def test_the_make_targets_and_modules_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^make ([\w-]+)|; make ([\w-]+)", TEXT, re.M))
    assert {first or second for first, second in targets} == {"test", "test-slow", "lint"}
    assert all(re.search(rf"^{first or second}:", makefile, re.M) for first, second in targets)
    for module in re.findall(r"python -m (benchmarks[\w.]*)", TEXT):
        parts = module.split(".")
        assert (ROOT.joinpath(*parts).with_suffix(".py")).exists() or (ROOT.joinpath(*parts) / "__main__.py").exists()
