"""Ctrl-C while a process is started reaches this one, and never that one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from legs_loss.system.ctrl_c import held_back, noted
from tests.support import ROOT, legs_environment

SCRIPT = """
import multiprocessing, os, signal
from legs_loss.system.ctrl_c import held_back, noted
from legs_loss.precompute.executors import keep_ctrl_c_from_children


def ask(answers):
    answers.put(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))


if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    answers = context.SimpleQueue()
    try:
        with keep_ctrl_c_from_children():
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


def strike():
    os.kill(os.getpid(), signal.SIGINT)


def test_steps_that_belong_together_are_finished_first():
    done = []

    def steps():
        with held_back():
            strike()
            strike()
            done.append("both")

    with pytest.raises(KeyboardInterrupt):
        steps()
    assert done == ["both"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_step_that_fails_loses_no_ctrl_c():
    def steps():
        with held_back():
            strike()
            raise ValueError("a step fails")

    with pytest.raises(KeyboardInterrupt) as caught:
        steps()
    assert isinstance(caught.value.__context__, ValueError)


def test_what_is_only_noted_ends_nothing():
    with noted() as struck:
        assert not struck()
        strike()
        assert struck()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_what_is_ignored_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with held_back(), noted() as struck:
            strike()
            assert not struck()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
