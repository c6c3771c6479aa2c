"""``legs env`` reports the backends, in every state of a machine."""

from __future__ import annotations

import os

import torch

from tests.support import legs, legs_environment


def lines(done):
    assert done.returncode == 0, done.stderr
    return {line[:16].strip(): line[17:] for line in done.stdout.splitlines()}


def test_it_names_versions_and_the_backend_with_the_reason():
    environment = legs_environment()
    environment.pop("LEGS_BACKEND", None)
    found = lines(legs("env", env=environment))
    assert list(found)[:4] == ["legs-loss", "python", "torch", "CUDA"]
    assert found["torch"].startswith(torch.__version__)
    assert found["LEGS_BACKEND"] == "not set"
    try:
        import numba
    except ImportError:
        assert found["numba"] == "not installed"
        assert found["loss on cpu"] == "torch; numba: it is not installed"
    else:
        assert found["numba"] == numba.__version__
        assert found["loss on cpu"].startswith("numba; numba: its trial agreed with torch")


def test_a_forced_backend():
    found = lines(legs("env", env=dict(legs_environment(), LEGS_BACKEND="torch")))
    assert found["LEGS_BACKEND"] == "torch"
    assert found["loss on cpu"].startswith("torch")


def test_an_unknown_backend():
    done = legs("env", env=dict(legs_environment(), LEGS_BACKEND="metal"))
    assert done.returncode == 2
    assert "legs: error: LEGS_BACKEND must be one of torch, numba, cuda, got 'metal'" in done.stderr


def test_a_broken_and_a_missing_package(tmp_path):
    (tmp_path / "numba").mkdir()
    (tmp_path / "numba" / "__init__.py").write_text("raise ImportError('needs NumPy 1.99 or less')\n")
    environment = legs_environment()
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    environment.pop("LEGS_BACKEND", None)
    found = lines(legs("env", env=environment))
    assert found["numba"] == "broken: needs NumPy 1.99 or less"
    assert found["loss on cpu"] == "torch; numba: ImportError: needs NumPy 1.99 or less"
