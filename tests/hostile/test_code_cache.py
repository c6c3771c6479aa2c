"""numba's compiled code on disk: damaged, outdated, for another processor, written by several, nowhere to write."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support import legs_environment

pytest.importorskip("numba")

INNER = """
from typing import NamedTuple
import numpy as np
from legs_loss.kernels.compiling import compiled, part

class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray

@part()
def scaled(value):
    return 2.0 * value
"""
OUTER = """
import sys
import numpy as np
from legs_loss.kernels.compiling import compiled
from inner import Pair, scaled

@compiled()
def total(pair, offset):
    found = 0.0
    for j in range(pair.first.size):
        found += scaled(pair.first[j]) * pair.second[j]
    return found + offset

if __name__ == "__main__":
    first, second = np.arange(1.0, 4.0), np.array([1.0, 10.0, 100.0])
    kind = sys.argv[1] if len(sys.argv) > 1 else "float64"
    print(total(Pair(first.astype(kind), second.astype(kind)), 0.5), sum(total._cache_hits.values()))
"""


class Code:
    """Two modules of a user's with compiled functions, whose code lies in a folder of its own."""

    def __init__(self, folder):
        self.folder, self.cache = folder, folder / "cache"
        (folder / "inner.py").write_text(INNER)
        (folder / "outer.py").write_text(OUTER)

    def start(self, *arguments, **environment):
        environment = {**legs_environment(), "NUMBA_CACHE_DIR": str(self.cache), **environment}
        environment["PYTHONPATH"] = os.pathsep.join([str(self.folder), environment["PYTHONPATH"]])
        command = [sys.executable, str(self.folder / "outer.py"), *arguments]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def run(self, *arguments, **environment):
        """Return what it computes, how often compiled code was loaded, and what was said."""
        out, said = self.start(*arguments, **environment).communicate(timeout=300)
        assert out, said
        value, loaded = out.split()
        return float(value), int(loaded), said

    def files(self):
        return sorted(self.cache.rglob("*.nbc"))


@pytest.fixture
def code(tmp_path):
    return Code(tmp_path)


RIGHT = 2.0 * (1.0 + 20.0 + 300.0) + 0.5


def truncated(content):
    return content[: len(content) // 2]


def flipped(content):
    return content[:-900] + bytes([content[-900] ^ 4]) + content[-899:]


DAMAGES = [truncated, flipped, lambda _: b"", lambda _: b"\x80\x04not a pickle", lambda content: content[:16]]


def test_code_is_loaded_by_the_next_process(code):
    assert code.run() == (RIGHT, 0, "")
    assert len(code.files()) == 1
    assert code.run() == (RIGHT, 1, "")


@pytest.mark.slow
def test_damaged_files_are_repaired(code):
    code.run()
    whole = {path: path.read_bytes() for path in code.files()}
    for damage in DAMAGES:
        for path, content in whole.items():
            path.write_bytes(damage(content))
        assert code.run() == (RIGHT, 0, "")  # compiled anew, without a word
    assert code.run() == (RIGHT, 1, "")  # and kept


@pytest.mark.slow
def test_a_folder_in_the_place_of_a_file_is_named(code):
    code.run()
    for path in code.files():
        path.unlink()
        path.mkdir()
    value, _, said = code.run()
    assert value == RIGHT
    assert said.count("\n") == 1 and str(code.cache) in said and "NUMBA_CACHE_DIR" in said


@pytest.mark.slow
def test_code_of_another_processor_is_left_alone(code):
    assert code.run(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="")[:2] == (RIGHT, 0)
    assert code.run() == (RIGHT, 0, "")
    assert len(code.files()) == 2
    assert code.run(NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="")[:2] == (RIGHT, 1)


@pytest.mark.slow
def test_a_changed_function_of_another_file_is_compiled_in_anew(code):
    """The unchanged file's code has the other's inside."""
    code.run()
    inner, outer = code.folder / "inner.py", code.folder / "outer.py"
    inner.write_text(INNER.replace("2.0 * value", "3.0 * value"))
    assert code.run() == (1.5 * (RIGHT - 0.5) + 0.5, 0, "")
    assert len(code.files()) == 1  # what the old sources made is gone
    inner.write_text(inner.read_text().replace("Pair", "Both"))
    outer.write_text(OUTER.replace("Pair", "Both"))
    assert code.run() == (1.5 * (RIGHT - 0.5) + 0.5, 0, "")


@pytest.mark.slow
def test_a_changed_number_of_a_file_that_compiles_nothing_is_compiled_in_anew(code):
    numbers, inner = code.folder / "numbers_of_a_test.py", code.folder / "inner.py"
    numbers.write_text("FACTOR = 2.0\n")
    inner.write_text("from numbers_of_a_test import FACTOR\n" + INNER.replace("2.0 * value", "FACTOR * value"))
    for loaded in (0, 1):
        assert code.run() == (RIGHT, loaded, "")
    numbers.write_text("FACTOR = 3.0\n")
    assert code.run() == (1.5 * (RIGHT - 0.5) + 0.5, 0, "")


@pytest.mark.slow
def test_fields_in_another_order_are_read_anew(code):
    """The class of an argument stands in a file that the compiled function's does not import from."""
    groups, outer = code.folder / "groups_of_a_test.py", code.folder / "outer.py"
    fields = "from typing import NamedTuple\n\n\nclass Pair(NamedTuple):\n    {}: object\n    {}: object\n"
    outer.write_text(
        OUTER.replace("Pair, ", "")
        .replace("* pair.second", "+ pair.second")
        .replace("Pair(first.astype(kind), second.astype", PAIR)
    )
    for order in (("first", "second"), ("second", "first")):
        groups.write_text(fields.format(*order))
        for loaded in (0, 1):
            assert code.run()[:2] == (2.0 * 6.0 + 111.0 + 0.5, loaded)


PAIR = "__import__('groups_of_a_test').Pair(first=first.astype(kind), second=second.astype"


def test_the_sources_of_the_lab_are_those_that_it_compiles_in(monkeypatch):
    from pathlib import Path

    from legs_loss.kernels import code_cache
    from legs_loss.lab.surfels import strips

    read, bytes_of = [], Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append("/".join(path.parts[-2:])) or bytes_of(path))
    code_cache._stamp.cache_clear()
    code_cache._stamp(strips.__name__)
    assert {"lab/conventions.py", "surfels/model.py", "surfels/strips.py", "simd/lanes.py"} <= set(read)
    assert "rasterizer/oracle.py" not in read


@pytest.mark.slow
def test_processes_that_compile_at_once_do_not_mix_up(code):
    kinds = ["float64", "int32"]
    for loaded in (0, 1):
        running = [code.start(kind) for kind in kinds + kinds]
        for one in running:
            out, said = one.communicate(timeout=300)
            value, hits = out.split()
            assert float(value) == RIGHT and said == ""
            assert loaded == 0 or int(hits) == 1
    assert not [path for path in code.cache.rglob("*") if path.is_file() and path.suffix != ".nbc"]


@pytest.mark.parametrize("home", ["missing", "read-only"])
def test_without_a_folder_to_write_it_is_said_once(code, home):
    (code.folder / "__pycache__").write_text("")  # beside the code there is no place either
    nowhere = "/proc/none" if home == "missing" else "/dev/null"
    value, loaded, said = code.run(
        HOME=nowhere, XDG_CACHE_HOME=nowhere, NUMBA_CACHE_DIR="", PYTHONDONTWRITEBYTECODE="1"
    )
    assert (value, loaded) == (RIGHT, 0)
    assert said.count("\n") == 1 and "every run compiles anew" in said and "NUMBA_CACHE_DIR" in said


STEP = """
import torch, legs_loss
torch.manual_seed(0)
image, target = torch.rand(3, 20, 31, requires_grad=True), torch.rand(3, 20, 31)
loss = legs_loss.l1_loss(image, target)
exact = (legs_loss.weight_map(target.double()) * (image - target).abs()).mean()
print(type(loss.grad_fn).__name__, abs(float(loss - exact)) < 1e-5)
"""


@pytest.mark.slow
def test_a_damaged_cache_does_not_turn_the_fast_loss_off(tmp_path):
    environment = {**legs_environment(), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def step():
        done = subprocess.run(
            [sys.executable, "-c", STEP], env=environment, capture_output=True, text=True, cwd=tmp_path
        )
        assert done.returncode == 0 and "unavailable" not in done.stderr, done.stderr
        return done.stdout

    assert step() == "_FusedLossBackward True\n"
    for damage in DAMAGES:
        for path in (tmp_path / "cache").rglob("*.nbc"):
            path.write_bytes(damage(path.read_bytes()))
        assert step() == "_FusedLossBackward True\n"
