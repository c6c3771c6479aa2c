"""The tests of the kernels, on the device."""

from __future__ import annotations

import os
from collections import Counter
from typing import Any, Dict

from benchmarks.gpu.options import ROOT, Options, Record

__all__ = ["tests"]

FILE = ROOT / "tests" / "kernels" / "test_cuda_kernels.py"


def tests(options: Options, record: Record) -> None:
    """Run tests/kernels/test_cuda_kernels.py on the device; record how many passed, and each failure, as they come."""
    import pytest

    os.environ["LEGS_TEST_DEVICE"] = "cpu" if options.emulate else "cuda"
    outcomes: Counter[str] = Counter()
    failures: Dict[str, str] = {}

    class Recorder:
        def pytest_runtest_logreport(self, report: Any) -> None:
            if report.when == "call" or report.outcome != "passed":  # a failing or skipping fixture has no call
                outcomes[report.outcome] += 1
                if report.failed:
                    lines = str(report.longrepr).strip().splitlines()
                    failures[report.nodeid] = next((line for line in lines if line.startswith("E ")), lines[-1])[:300]
                record(**outcomes, failures=failures)

    code = pytest.main([str(FILE), "-q", "-m", "not slow", "--tb=short"], plugins=[Recorder()])
    if code != 0:
        raise AssertionError(f"{outcomes['failed']} tests failed (pytest's exit code {int(code)})")
