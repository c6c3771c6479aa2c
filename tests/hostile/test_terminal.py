"""Names that a terminal would obey, or cannot show, are printed as escapes; nothing ends for them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.patching_support import checkout, files
from tests.support import legs_environment


def legs_patch(*arguments, encoding):
    command = [sys.executable, "-m", "legs_adapters.cli", *map(str, arguments)]
    environment = dict(legs_environment(), PYTHONIOENCODING=encoding)
    return subprocess.run(command, capture_output=True, env=environment, timeout=300)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_every_mode_prints_and_ends_well(encoding, tmp_path):
    name = "träin\x1b[2J\x1b]0;owned\x07→.py"
    source = files("inria")
    root = checkout(tmp_path, {**source, name: source["train.py"], "broken\x1b[31m.py": "def ("})
    for arguments, code in ((["--diff"], 0), (["--check"], 1), ([], 0), (["--undo", "--diff"], 0), (["--undo"], 0)):
        done = legs_patch(*arguments, root, encoding=encoding)
        assert done.returncode == code, done.stderr
        assert b"\x1b" not in done.stdout + done.stderr
        assert b"\x07" not in done.stdout + done.stderr
        assert b"Traceback" not in done.stderr
        assert b"\\x1b[2J" in done.stdout
    missing = legs_patch("nowhere\x1b[2J", encoding=encoding)
    assert (missing.returncode, missing.stderr.count(b"\x1b")) == (2, 0)
