"""The tests of the kernels, on the device, alone and under NVIDIA's sanitizer."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from typing import Any, Dict

from benchmarks.gpu.options import ROOT, Options, Record, Skipped

__all__ = ["memcheck", "racecheck", "tests"]

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


def racecheck(options: Options, record: Record) -> None:
    """Run some of them under ``compute-sanitizer --tool racecheck``: no thread reads what another writes in a phase."""
    _sanitized(options, record, "racecheck")


def memcheck(options: Options, record: Record) -> None:
    """Run some of them under ``compute-sanitizer --tool memcheck``: no access is out of bounds."""
    _sanitized(options, record, "memcheck")


def _sanitized(options: Options, record: Record, tool: str) -> None:
    sanitizer = shutil.which("compute-sanitizer") or "/usr/local/cuda/bin/compute-sanitizer"
    if options.emulate:
        raise Skipped("needs CUDA")
    if not os.access(sanitizer, os.X_OK):
        raise Skipped("compute-sanitizer is not installed")
    command = [sanitizer, "--tool", tool, "--error-exitcode", "9", sys.executable, "-m", "pytest", str(FILE), "-q"]
    command += ["-m", "not slow", "-k", "value_and_gradient_equal_the_reference or TestRange"]
    environment = {**os.environ, "LEGS_TEST_DEVICE": "cuda", "PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    done = subprocess.run(command, cwd=str(ROOT), env=environment, capture_output=True, text=True)
    summary = re.findall(r"^=+ (?:ERROR|RACECHECK) SUMMARY.*$", done.stdout, re.MULTILINE)
    record(summary=summary[-1:], pytest=done.stdout.strip().splitlines()[-3:])
    if done.returncode != 0:
        raise AssertionError(f"{tool} ended with exit code {done.returncode}: {(summary or ['no summary'])[-1]}")
