"""The script for a GPU: run to its end with the emulated kernels, stopped, interrupted, and where there is no GPU."""

from __future__ import annotations

import doctest
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

pytest.importorskip("numba")

from benchmarks.gpu import aims, building, imports, measured
from benchmarks.gpu.__main__ import MINUTES
from benchmarks.gpu.options import ROOT, Options, Skipped
from benchmarks.gpu.stages import CERTAIN, STAGES
from benchmarks.losses import timing
from tests import preloaded
from tests.cuda_emulation import COMPILER
from tests.lab.experiments.miniature import RENDER, RENDERER, TRAIN
from tests.support import legs_environment

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs g++")


def command(*arguments: Any) -> list[str]:
    return [sys.executable, "-m", "benchmarks.gpu", *map(str, arguments)]


def environment(**settings: str) -> dict[str, str]:
    return dict(legs_environment(), **settings)


def run(*arguments: Any, **settings: str) -> Any:
    return preloaded.run(command(*arguments), cwd=str(ROOT), env=environment(**settings), timeout=1500)


def codebase(root: Path, scene: Path) -> Path:
    """Write a checkout with 3DGS's files and options, and a CUDA module that uses calls removed in CUDA 13."""
    for name, text in (
        ("train.py", TRAIN.replace("parser.parse_args()", "parser.parse_known_args()[0]")),
        ("render.py", RENDER.replace("parser.parse_args()", "parser.parse_known_args()[0]")
            .replace('"--source_path")', f'"--source_path", default={str(scene)!r})')
            .replace("default=24", "default=48")),
        ("gaussian_renderer.py", RENDERER),
        ("arguments/__init__.py", "densify_grad_threshold = 0.0002"),
        ("submodules/rasterizer/setup.py", ""),
        ("submodules/rasterizer/forward.cu", "__global__ void last() { reduce(cub::Max()); }\n"),
    ):  # fmt: skip
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.slow
@needs_compiler
def test_it_runs_to_its_end_with_the_emulated_kernels(tiny_scene: Path, tmp_path: Path) -> None:
    root, file = codebase(tmp_path / "checkout", tiny_scene), tmp_path / "gpu.json"
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    # Of the kernels' tests a few: all of them are run by this suite itself.
    done = run(
        "--emulate", "--sizes", "24x16", "--json", file, "--fastgs", root, "--scene", tiny_scene,
        "--iterations", 30, PATH="/usr/bin:/bin", PYTEST_ADDOPTS="-k TestRange",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    found = json.loads(file.read_text())
    assert list(found) == [*STAGES, "aims"]
    assert {name for name in STAGES if found[name]["status"] == "done"} >= {"machine", "tests", "times", "compile"}
    assert found["machine"]["backend"] == "cuda: emulated on the CPU"
    assert found["tests"]["passed"] == 15 and found["tests"]["failures"] == {}
    table = found["times"]["24x16"]
    assert table["l1_loss, of known views"]["median ms"] > 0
    assert table["fused-ssim + L1"] == {"skipped": "needs CUDA"}
    for name in ("racecheck", "memcheck", "synchronisation", "graph", "stream"):
        assert found[name]["status"] == "skipped" and found[name]["reason"].startswith("needs CUDA")
    if torch.version.cuda is None:
        assert found["fused-ssim"]["reason"] == "needs a torch with CUDA"
        assert found["fastgs-build"]["mended"] == ["submodules/rasterizer/forward.cu"]
    for arm, weighted in (("plain", 0), ("LEGS", 30)):
        assert found["fastgs"][arm]["steps"] == 30 and found["fastgs"][arm]["weighted"] == weighted
        assert found["fastgs"][arm]["ms a step"] > 0 and found["fastgs"][arm]["PSNR held out"] > 5
    assert found["fastgs"]["LEGS"]["gaussians"] > found["fastgs"]["plain"]["gaussians"]
    assert found["aims"] == {"aims": "not measured: the kernels were emulated"}
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


@needs_compiler
def test_no_stage_outlasts_the_time_and_what_was_found_stays(tmp_path: Path) -> None:
    file = tmp_path / "gpu.json"
    file.write_text(json.dumps({"machine": {"status": "done", "GB/s of a copy": 4000}}))
    began = time.monotonic()
    done = run("--emulate", "--stages", "times", "graph", "--sizes", "3000x2000", "--minutes", "0.05", "--json", file)
    assert time.monotonic() - began < 120
    found = json.loads(file.read_text())
    assert done.returncode == 1 and "not well: times" in done.stdout
    assert found["machine"]["GB/s of a copy"] == 4000
    assert found["times"]["status"] == "timed out"
    assert found["graph"] == {"status": "skipped", "reason": "no time was left"}


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="signals are POSIX's")
@pytest.mark.slow
def test_an_interrupt_leaves_no_process_and_a_whole_file(tmp_path: Path) -> None:
    file = tmp_path / "gpu.json"
    arguments = ["--emulate", "--stages", "times", "--sizes", "8x8", "3000x2000", "--json", file, "--work", tmp_path]
    running = subprocess.Popen(command(*arguments), cwd=str(ROOT), env=environment(), stderr=subprocess.PIPE, text=True)
    records = tmp_path / "times.jsonl"
    while not (records.exists() and "8x8" in records.read_text()):
        assert running.poll() is None
        time.sleep(0.2)
    running.send_signal(signal.SIGTERM)
    _, said = running.communicate(timeout=60)
    assert running.returncode == 130 and "interrupted" in said
    found = json.loads(file.read_text())["times"]
    assert found["status"] == "interrupted" and set(found) == {"8x8", "status", "seconds"}
    others = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True).stdout
    assert str(records) not in others


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_it_says_that_there_is_no_gpu() -> None:
    done = run()
    assert done.returncode == 2 and "torch finds no CUDA GPU here" in done.stderr


def test_what_every_run_must_have_fits_into_its_time_and_comes_first() -> None:
    assert sum(stage.minutes for stage in CERTAIN.values()) < MINUTES
    assert list(STAGES)[: len(CERTAIN)] == list(CERTAIN)
    assert {"tests", "racecheck", "memcheck", "times", "fastgs"} <= set(CERTAIN)
    assert all(callable(stage.load()) for stage in STAGES.values())


def test_what_cub_no_longer_has_is_written_anew(tmp_path: Path) -> None:
    (tmp_path / "a.cu").write_text("x = Reduce(y, cub::Max());\n")
    (tmp_path / "b.cu").write_text("x = y;\n")
    assert building.mend(tmp_path) == [tmp_path / "a.cu"]
    assert (tmp_path / "a.cu").read_text() == "#include <cuda/functional>\nx = Reduce(y, cuda::maximum<>());\n"
    assert building.mend(tmp_path) == []


def test_what_a_script_lacks_is_known_before_anything_is_built(tmp_path: Path) -> None:
    for name, text in (
        ("train.py", "import os, torch.nn\nfrom scene import Scene\nimport utils\nimport rasterizer_module._C\n"),
        ("scene/__init__.py", "from scene.cameras import Camera\n"),
        ("scene/cameras.py", "from no_such_package.sub import thing\nfrom . import other\n"),
        ("utils.py", "try:\n    import optional_package\nexcept ImportError:\n    pass\n"),
        ("unused.py", "import another_package\n"),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert imports.missing(tmp_path / "train.py") == ["no_such_package", "rasterizer_module"]
    with pytest.raises(Skipped, match=r"^train.py needs what is not installed: no_such_package$"):
        imports.need([tmp_path / "train.py"], built={"rasterizer_module"})
    imports.need([tmp_path / "utils.py"])


def test_a_module_that_is_built_already_is_not_built_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """fused-ssim is, by a stage of its own."""
    for name in ("FastGS/train.py", "FastGS/render.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("import fused_ssim_of_a_test, rasterizer_of_a_test\n")
    for module in ("fused_ssim_of_a_test", "rasterizer_of_a_test"):
        (tmp_path / "FastGS" / "submodules" / module / module).mkdir(parents=True)
        (tmp_path / "FastGS" / "submodules" / module / "setup.py").write_text("")
    built: list[str] = []
    monkeypatch.setattr(building, "torch", SimpleNamespace(version=SimpleNamespace(cuda="13.0")))
    monkeypatch.setattr(building, "_build", lambda source, site: built.append(source.name))
    options = Options(False, (), 1, str(tmp_path), str(tmp_path), None, None, None, 1, None)
    (options.site / "fused_ssim_of_a_test").mkdir(parents=True)
    building.fastgs_modules(options, lambda **found: None)
    assert built == ["rasterizer_of_a_test"]


def test_a_gpus_time_begins_when_all_steps_are_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else of a small image it would be the time that Python takes to launch them."""
    order: list[str] = []

    class Event:
        def __init__(self, enable_timing: bool) -> None:
            pass

        def record(self) -> None:
            order.append("event")

        def synchronize(self) -> None:
            order.append("wait")

        def elapsed_time(self, end: Any) -> float:
            return 5.0

    cuda = SimpleNamespace(
        Event=Event, _sleep=lambda cycles: order.append(f"sleep {cycles / timing.FASTEST_CLOCK:g} s")
    )
    monkeypatch.setattr(timing, "torch", SimpleNamespace(cuda=cuda))
    assert timing.between_events(lambda: order.append("step"), launched=0.001) == 5.0 / 1e3 / timing.STEPS
    assert order == ["sleep 0.02 s", "event", *["step"] * timing.STEPS, "event", "wait"]


@pytest.mark.parametrize("module", [aims, measured], ids=lambda module: module.__name__)
def test_examples(module: Any) -> None:
    found = doctest.testmod(module)
    assert found.attempted > 0 and found.failed == 0
