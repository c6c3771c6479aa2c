"""The tables of curves and operators as kernels take them; a new curve, by the recipe, in every language; the trial."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from legs_loss import WeightSpec, legs_loss
from legs_loss.curves import FORMULAS
from legs_loss.kernels import codes
from legs_loss.kernels.available import BACKENDS
from legs_loss.kernels.cuda import modules
from legs_loss.operators import OPERATORS, Operator, gradient
from tests.cuda_emulation import COMPILER
from tests.kernels.support import images, used
from tests.support import legs_environment

ROOT = Path(__file__).parents[2]


def test_the_formulas_in_another_language():
    assert codes.formulas_in({"x": "y", "sqrt": "root"}, "{}f".format) == {
        "C1": "y",
        "C2": "y * y",
        "C3": "root(y)",
        "C4": "y * y * (3.0f - 2.0f * y)",
    }


def test_cuda_divides_by_a_number_as_it_multiplies():
    source = modules.source().decode()
    assert "CURVE(5, saturated(0.5f - short_sine(asinf(1.0f - 2.0f * x) * (1.0f / 3.0f))))" in source
    assert re.findall(r"CURVE\((\d), ", source.splitlines()[3])[:2] == ["3", "1"]


@pytest.mark.parametrize(
    ("stencils", "expected"),
    [
        (OPERATORS["laplacian"].stencils, (codes.FOUR, 0.0, 0.0)),
        (OPERATORS["laplacian8"].stencils, (codes.EIGHT, 0.0, 0.0)),
        (OPERATORS["central"].stencils, (codes.GRADIENT, 0.0, 0.5)),
        (gradient(((-1, 0, 1), (-1, 0, 1), (-1, 0, 1))), (codes.GRADIENT, 1.0, 1.0)),  # Prewitt's
        ((((1, 2, 1), (2, -12, 2), (1, 2, 1)),), None),
        ((((1, 0, -1), (0, 0, 0), (-1, 0, 1)),), None),
        (gradient(((-1, 0, 1), (-2, 0, 2), (-1, 0, 1)))[:1], None),
        ((((0, 0, 1, 0, 0), (0,) * 5, (1, 0, -4, 0, 1), (0,) * 5, (0, 0, 1, 0, 0)),), None),
    ],
)
def test_which_kernel_an_operator_has(stencils, expected):
    assert codes._stencil_of(Operator("a", stencils, "a test")) == expected


class TestTheTrial:
    @pytest.fixture(autouse=True)
    def anew(self, monkeypatch):
        pytest.importorskip("numba")
        importlib.import_module("legs_loss.kernels.numba_loss")  # its code is made of the tables as they are
        monkeypatch.setattr(BACKENDS, "found", {})
        monkeypatch.setenv("LEGS_BACKEND", "numba")

    @pytest.mark.parametrize(
        ("table", "name", "other", "spec"),
        [
            ("CURVES", "C2", "C3", WeightSpec(curve="C2")),
            ("STENCILS", "sobel", "scharr", WeightSpec(operator="sobel")),
            ("NORMS", 1.0, float("inf"), WeightSpec(p=1.0)),
        ],
    )
    def test_it_is_of_what_is_in_use(self, monkeypatch, capfd, table, name, other, spec):
        numbers = getattr(codes, table)
        monkeypatch.setitem(numbers, name, numbers[other])
        assert used(legs_loss(*images((3, 20, 30)))) == "fused"  # whose own is right
        assert used(legs_loss(*images((3, 20, 30)), spec)) == "torch"
        assert "numba is unavailable, torch is used: its trial of the" in capfd.readouterr().err

    def test_it_runs_once_whatever_beta_is(self, monkeypatch):
        from legs_loss.kernels import trial

        tried, difference = [], trial.difference_from_torch
        monkeypatch.setattr(
            trial, "difference_from_torch", lambda *given: tried.append(given[3].curve) or difference(*given)
        )
        for beta, curve in ((3.0, "C1"), (4.0, "C1"), (4.0, "C2"), (5.0, "C1")):
            assert used(legs_loss(*images((3, 20, 30)), WeightSpec(curve=curve, beta=beta))) == "fused"
        assert tried == ["C1", "C2"]


RECIPE = """
import sys
import torch
from legs_loss import WeightSpec, legs_loss, register_curve
from legs_loss.kernels import numba_loss
from legs_loss.kernels.contract import L1
from legs_loss.weights import Weights

register_curve("by-hand", lambda x: 2 * x.sqrt() - x)
target = torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(1))
image = 0.9 * target + 0.02
exact = float(legs_loss(image.double(), target.double(), WeightSpec(curve="by-hand"), lambda_dssim=0.0))
backends = [numba_loss.BACKEND]
if sys.argv[1:]:
    from tests.cuda_emulation import emulated

    backends.append(emulated())
for backend in backends:
    spec = WeightSpec(curve="new")
    assert backend.makes_weights_of(spec), backend.name
    found = float(backend.loss(L1, image, target, Weights(spec)))
    assert abs(found - exact) < 1e-5 * exact, (backend.name, found, exact)
"""


@pytest.mark.slow  # it compiles
def test_a_curve_that_follows_the_recipe_is_computed_by_every_backend(tmp_path):
    pytest.importorskip("numba")
    shutil.copytree(str(ROOT / "legs_loss"), str(tmp_path / "legs_loss"), ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(str(ROOT / "tests" / "cuda_emulation"), str(tmp_path / "tests" / "cuda_emulation"))
    table = tmp_path / "legs_loss" / "curves.py"
    text, last = table.read_text(encoding="utf-8"), f'    "C5": "{FORMULAS["C5"]}",'
    assert last in text
    environment = dict(legs_environment(), PYTHONPATH=str(tmp_path), NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    command, said = [sys.executable, "-c", RECIPE, *(["cuda"] if COMPILER else [])], []
    for formula in ("x * x", "unit(2 * sqrt(x) - x)"):  # of the first nothing is left in the machine code on disk
        table.write_text(text.replace(last, f'{last}\n    "new": "{formula}",'), encoding="utf-8")
        done = subprocess.run(command, cwd=str(tmp_path), env=environment, stdout=-1, stderr=-1, text=True)
        said.append(done.stderr)
    assert "AssertionError: ('numba', " in said[0]
    assert said[1] == "" and os.listdir(str(tmp_path / "cache"))
