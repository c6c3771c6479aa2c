"""Ctrl-C while a process is started reaches this one, and never that one."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.support import ROOT, legs_environment

SCRIPT = """
import multiprocessing, os, signal
from legs_loss.system import kept_from_children


def ask(answers):
    answers.put(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))


if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    answers = context.SimpleQueue()
    try:
        with kept_from_children():
            os.kill(os.getpid(), signal.SIGINT)
            child = context.Process(target=ask, args=(answers,))
            child.start()
            print("started")
        print("lost")
    except KeyboardInterrupt:
        print("interrupted")
    print("held back there:", answers.get())
    child.join()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_it_is_not_lost_and_not_inherited(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=str(ROOT),
        env=legs_environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.split("\n") == ["started", "interrupted", "held back there: True", ""], done.stderr
