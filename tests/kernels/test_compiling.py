"""Compiling is said, once a machine, and is in nobody's time."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

numba = pytest.importorskip("numba")

SMALL = """
import sys, numba
from legs_loss.kernels.compiling import compiled, said

@compiled()
def inner(x):
    return x + 1

@compiled()
def outer(x):
    return 2 * inner(x)

with said("legs test", "1 to 2 s", (outer,)):
    assert outer(20) == 42
"""


def run(code, tmp_path, **environment):
    path = tmp_path / "script.py"
    path.write_text(code, encoding="utf-8")
    environment = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path / "cache"), **environment)
    done = subprocess.run(
        [sys.executable, str(path)], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True
    )
    return done.stdout.decode().splitlines()


def test_a_first_run_says_that_it_compiles_and_for_how_long_and_a_second_says_nothing(tmp_path):
    first, last = run(SMALL, tmp_path)
    assert first == "legs test: compiling for this processor, once a machine: 1 to 2 s"
    assert last.startswith("legs test: compiled in ") and last.endswith(" s, and kept for later")
    assert run(SMALL, tmp_path) == []


def test_a_second_process_of_a_run_says_nothing(tmp_path):
    assert run(SMALL, tmp_path, RANK="1") == []


PART = """
from legs_loss.kernels.compiling import compiled, part

@part()
def thrice(x):
    return 3 * x

@compiled()
def caller(x):
    return thrice(x) + 1

assert caller(2) == 7
print([made.library.get_pointer_to_function(made.fndesc.mangled_name) for made in thrice.overloads.values()])
"""


def test_a_part_has_machine_code_in_those_that_call_it_alone(tmp_path):
    assert run(PART, tmp_path) == ["[0]"]
    assert [path.name.split(".")[1] for path in tmp_path.rglob("*.nbc")] == ["caller"]
    assert run(PART, tmp_path) == ["[]"]


TRAINING = """
from numba.core import event
from legs_loss.lab.training.trainer import TrainConfig, compile_step, train
from legs_loss.scenes import read_scene

compile_step("legs test")
recorder = event.RecordingListener()
with event.install_listener("numba:compile", recorder):
    for preset in ("3dgs", "legs"):
        train(read_scene({scene!r}), TrainConfig(preset, iterations=3))
print([record.data["dispatcher"].py_func.__name__ for _, record in recorder.buffer])
"""


@pytest.mark.slow
def test_a_training_compiles_nothing_once_its_step_is_compiled(tiny_scene, tmp_path):
    said, names = run(TRAINING.format(scene=str(tiny_scene)), tmp_path)[0::2]
    assert said.startswith("legs test: compiling") and names == "[]"
