"""The open-ended harness itself: a few damaged files of every reader, in every run of the tests."""

from __future__ import annotations

import sys
from pathlib import Path

from benchmarks import fuzz
from tests.preloaded import run
from tests.support import legs_environment

ROOT = Path(__file__).resolve().parents[2]


def test_a_few_cases_of_every_reader(tmp_path):
    cases = 10 * len(fuzz.READERS)
    command = [sys.executable, "-m", "benchmarks.fuzz", "--cases", str(cases), "--seed", "3", "--keep", str(tmp_path)]
    done = run(command, cwd=str(ROOT), env=legs_environment(), timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    each = ", ".join(f"{name} 10" for name in fuzz.READERS)
    assert done.stdout == f"seed 3: {cases} cases, 0 failed; {each}\n"


def test_what_breaks_a_promise_is_found(tmp_path, monkeypatch):
    def traceback(folder):
        raise KeyError("what a reader let through")

    def writes_outside(folder):
        (folder.parent / "outside").write_text("")

    make = fuzz.READERS["settings"][0]
    good = tmp_path / "good"
    good.mkdir()
    make(good)
    watch = fuzz.Watch(tmp_path / "work")
    for read, said in ((traceback, "KeyError"), (writes_outside, "outside"), (fuzz.read_settings, "")):
        monkeypatch.setitem(fuzz.READERS, "settings", (make, ["legs.toml"], read))
        (tmp_path / "work").mkdir(exist_ok=True)
        wrong = fuzz.run_case("settings", good, tmp_path / "work", fuzz.random.Random(1), watch)
        assert (said in wrong) and bool(wrong) == bool(said)
