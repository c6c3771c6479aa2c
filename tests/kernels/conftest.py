"""Fixtures of the tests of the CUDA kernels' loading."""

from __future__ import annotations

import pytest

from legs_loss.kernels.cuda.modules import BinaryCache, Modules
from tests.kernels.parts import FakeCompiler, FakeDriver


@pytest.fixture
def parts(tmp_path):
    driver, compiler = FakeDriver(), FakeCompiler()
    return driver, compiler, Modules(driver, compiler, BinaryCache(tmp_path / "kernels"))
